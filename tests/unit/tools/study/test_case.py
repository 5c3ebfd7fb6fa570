from __future__ import annotations

import msgspec
import pytest

from companion.estimation.filters.target_filter import FilterParams
from tests.unit.tools.study.reporting.case_helpers import canonical_case
from tools.study.case import PAPER_BELIEF, Case


def test_the_canonical_case_is_the_default() -> None:
    assert canonical_case() == Case()


def test_the_filter_knows_the_noise_of_ranges() -> None:
    case = canonical_case(range_sigma_m=0.5)
    assert case.channel.range_sigma_m == case.belief.range_sigma_m == 0.5


def test_what_the_tables_vary() -> None:
    case = canonical_case(p_nlos=0.3, mean_bias_m=12.0, range_k=4.0)
    assert (case.channel.p_nlos, case.channel.range_bias_mean_m) == (0.3, 12.0)
    assert (case.belief.range_k_long, case.belief.range_k_short) == (4.0, None)


def test_the_place_of_the_sensor_is_known() -> None:
    assert PAPER_BELIEF.own_position_sigma_m == 0.0


@pytest.mark.parametrize(
    "belief",
    [
        FilterParams(process_noise_m_per_sqrt_s=0.1),
        FilterParams(target_height_m=1.0),
        FilterParams(target_height_sigma_m=1.0),
    ],
)
def test_what_the_compiled_walk_does_not_do_is_refused(belief: FilterParams) -> None:
    with pytest.raises(ValueError, match="belief"):
        Case(belief=belief)


def test_a_misspelt_key_is_refused() -> None:
    with pytest.raises(msgspec.ValidationError, match="step_size"):
        msgspec.convert({"step_size": 3.0}, Case)
