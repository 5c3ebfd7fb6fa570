"""Every filter, in every variant."""

from __future__ import annotations

import pytest

from companion.estimation.filters.target_filter import FilterParams
from tests.contract.filter_helpers import FILTERS, VARIANTS
from tests.contract.hostile_sequences import MakeFilter


@pytest.fixture(params=VARIANTS)
def params(request: pytest.FixtureRequest) -> FilterParams:
    return VARIANTS[request.param]


@pytest.fixture(params=FILTERS)
def make(request: pytest.FixtureRequest) -> MakeFilter:
    return FILTERS[request.param]
