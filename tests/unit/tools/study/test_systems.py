from __future__ import annotations

import math

import pytest

from companion.errors import ConfigError
from tests.unit.tools.study.reporting.case_helpers import canonical_case
from tools.study.case import Case
from tools.study.systems import (
    System,
    belief_of,
    recursive_filter_of,
    system_named,
)


@pytest.mark.parametrize(
    ("name", "label"),
    [
        ("asymmetric_huber/reactive", "Proposed (Reactive)"),
        ("admm/passive", "ADMM (Passive)"),
        ("huber/fim", "Huber (FIM)"),
        ("map/latched", "MAP (Latched)"),
        ("tracker/latched", "Companion (Latched)"),
        ("huber/fim_printed", "Huber (FIM as printed)"),
    ],
)
def test_labels_are_those_of_the_papers_tables(name: str, label: str) -> None:
    assert system_named(name).label == label


@pytest.mark.parametrize("name", ["kalman/fim", "huber/orbit", "huber", ""])
def test_an_unknown_system_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match="none of"):
        system_named(name)


def test_kernels_fly_the_companions_filters_and_the_window() -> None:
    assert system_named("ekf/fim").is_compiled
    assert system_named("map/fim").is_compiled
    assert not system_named("tracker/fim").is_compiled


def test_only_the_window_is_solved() -> None:
    assert belief_of(Case(), system_named("map/fim")).is_window_solved
    assert not belief_of(Case(), system_named("asymmetric_huber/fim")).is_window_solved


def test_filters_differ_by_their_thresholds() -> None:
    case = canonical_case(range_k=2.5)
    thresholds = {
        name: belief_of(case, system_named(f"{name}/passive")).thresholds[0].tolist()
        for name in ("ekf", "huber", "asymmetric_huber", "admm")
    }
    assert thresholds == {
        "ekf": [math.inf, math.inf],
        "huber": [2.5, 2.5],
        "asymmetric_huber": [2.5, math.inf],
        "admm": [2.5, math.inf],
    }


def test_only_the_splitting_iterates() -> None:
    iterations = {
        name: belief_of(Case(), system_named(f"{name}/passive")).iterations
        for name in ("asymmetric_huber", "admm")
    }
    assert iterations["asymmetric_huber"] == 0
    assert iterations["admm"] > 0


def test_the_tracker_is_no_recursive_filter() -> None:
    with pytest.raises(ValueError, match="tracker"):
        recursive_filter_of(Case(), System("tracker", "fim"))
