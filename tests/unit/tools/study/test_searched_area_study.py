"""A small version of the study `area`, of other seeds than its own."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
import pytest

from companion.search.detection_model import DetectionModel
from tools.study import searched_area as study
from tools.study.searched_area import EMITTERS, Trial, csv_of, fly, reliability, success

FLIGHTS, SEED = 60, 4711


def error_of(trials: Sequence[Trial]) -> tuple[float, float]:
    """Return the mean of heard minus stated, and its standard error by flights."""
    errors = np.array([each.is_heard - each.pod for each in trials]).reshape(-1, EMITTERS)
    by_flight = errors.mean(axis=1)
    return float(by_flight.mean()), float(by_flight.std() / np.sqrt(len(by_flight)))


@pytest.fixture(scope="module")
def trials() -> list[Trial]:
    return [trial for number in range(FLIGHTS) for trial in fly(number, SEED)]


@pytest.mark.slow
def test_stated_probabilities_are_right_over_varied_worlds(trials: list[Trial]) -> None:
    error, sigma = error_of(trials)
    assert sigma < 0.02
    assert abs(error) < 3.0 * sigma
    middle = [each for each in trials if 0.2 <= each.pod < 0.8]
    heard = np.mean([each.is_heard for each in middle])
    assert heard == pytest.approx(np.mean([each.pod for each in middle]), abs=0.1)


def test_the_study_sees_a_model_that_is_too_hopeful(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = study.draw_world

    def hopeful(rng: np.random.Generator) -> tuple[study.World, DetectionModel]:
        world, model = drawn(rng)
        return world, msgspec.structs.replace(model, reach_m=1.7 * model.reach_m)

    monkeypatch.setattr(study, "draw_world", hopeful)
    error, sigma = error_of([trial for number in range(10) for trial in fly(number, SEED)])
    assert error < -3.0 * sigma


def test_cells_of_one_flight_count_as_one_in_the_standard_error() -> None:
    rng = np.random.default_rng(1)
    flights = [
        [Trial(number, "open", 0.5, 0.5, False, bool(rng.random() < 0.5))] * EMITTERS
        for number in range(400)
    ]
    (found,) = reliability([trial for trials in flights for trial in trials])
    assert found.sigma == pytest.approx(0.5 / np.sqrt(400), rel=0.05)


@pytest.mark.slow
def test_tables_hold_what_was_flown(trials: list[Trial]) -> None:
    bins = reliability(trials)
    assert sum(each.trials for each in bins) == FLIGHTS * EMITTERS
    assert csv_of(bins).splitlines()[0] == "world,pod_from,stated,heard,sigma,cells"
    stated, heard, flights = success(trials)
    assert flights == FLIGHTS
    assert stated == pytest.approx(heard, abs=0.2)
