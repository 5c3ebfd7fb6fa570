"""Accuracy of the own position: as it is reported, and as it is assumed without a report."""

from __future__ import annotations

import pytest

from companion.domain import Autopilot, FlightMode, PositionAccuracy, VehicleState
from companion.guidance.events import (
    AccuracySource,
    HeartbeatReceived,
    PositionAccuracyReported,
    VehicleMoved,
)
from companion.guidance.vehicle_track import MAX_AGE_S, PositionAccuracyWatch

RECEIVER, ESTIMATOR = AccuracySource.RECEIVER, AccuracySource.ESTIMATOR
MOVED = VehicleMoved(0.0, VehicleState(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))


def watch(
    *reports: tuple[float, AccuracySource, float | None, float | None],
) -> PositionAccuracyWatch:
    accuracies = PositionAccuracyWatch()
    accuracies.handle(MOVED)
    for each in reports:
        accuracies.handle(PositionAccuracyReported(*each))
    return accuracies


def test_the_receiver_is_believed() -> None:
    accuracies = watch((1.0, RECEIVER, 0.8, 1.4))
    assert accuracies.accuracy(2.0) == PositionAccuracy(0.8, 1.4, is_reported=True)


def test_of_two_the_worse_counts() -> None:
    worse = watch((1.0, RECEIVER, 0.8, 1.4), (1.0, ESTIMATOR, 2.0, 0.5))
    assert worse.accuracy(2.0) == PositionAccuracy(2.0, 1.4, is_reported=True)
    better = watch((1.0, RECEIVER, 0.8, 1.4), (1.0, ESTIMATOR, 0.2, 5.0))
    assert better.accuracy(2.0) == PositionAccuracy(0.8, 5.0, is_reported=True)


def test_a_height_that_is_not_reported_is_worse_than_the_place() -> None:
    assert watch((1.0, RECEIVER, 0.8, None)).accuracy(2.0) == PositionAccuracy(
        0.8, 1.6, is_reported=True
    )


@pytest.mark.parametrize("estimator_m", [0.02, 2.9])
def test_the_estimator_does_not_stand_for_the_receiver(estimator_m: float) -> None:
    accuracies = watch((1.0, RECEIVER, None, None), (1.0, ESTIMATOR, estimator_m, 0.1))
    assert accuracies.accuracy(2.0) == PositionAccuracy(3.0, 6.0, is_reported=False)


def test_what_is_not_reported_counts_as_no_better_than_what_is_known() -> None:
    accuracies = watch((1.0, RECEIVER, None, None), (1.0, ESTIMATOR, 8.0, 20.0))
    assert accuracies.accuracy(2.0) == PositionAccuracy(8.0, 20.0, is_reported=False)


@pytest.mark.parametrize(("before_m", "effective_m"), [(0.02, 3.0), (0.8, 3.0), (5.0, 5.0)])
def test_a_fix_that_is_lost_makes_it_worse_and_never_better(
    before_m: float, effective_m: float
) -> None:
    accuracies = watch((1.0, RECEIVER, before_m, None), (1.5, RECEIVER, None, None))
    assert accuracies.accuracy(2.0) == PositionAccuracy(
        effective_m, 2.0 * effective_m, is_reported=False
    )


@pytest.mark.parametrize(("before_m", "effective_m"), [(0.02, 3.0), (5.0, 5.0)])
def test_a_receiver_that_falls_silent_is_not_believed_for_long(
    before_m: float, effective_m: float
) -> None:
    accuracies = watch((1.0, RECEIVER, before_m, 0.1))
    reports, counted = accuracies.accuracy(1.0 + MAX_AGE_S), accuracies.accuracy(1.1 + MAX_AGE_S)
    assert reports is not None
    assert reports.is_reported
    assert counted is not None
    assert (counted.horizontal_m, counted.is_reported) == (effective_m, False)


def test_a_receiver_may_be_late_by_seconds_and_not_for_ever() -> None:
    for accuracies in (watch(), watch((0.1, ESTIMATOR, 0.3, 0.4))):
        assert accuracies.accuracy(MAX_AGE_S) is None
        assert accuracies.accuracy(0.1 + MAX_AGE_S) == PositionAccuracy(3.0, 6.0, is_reported=False)
    assert PositionAccuracyWatch().accuracy(100.0) is None


def test_jumps_before_arming_are_convergence() -> None:
    accuracies = watch((1.0, RECEIVER, 0.8, 1.4))
    for is_armed, kept_m in ((False, 5.0), (True, 0.0), (True, 5.0), (False, 5.0)):
        accuracies.jumped_en_m = (5.0, 0.0)
        accuracies.handle(
            HeartbeatReceived(2.0, Autopilot.PX4, FlightMode.HOLD, is_armed, True, False)
        )
        assert accuracies.jumped_en_m == (kept_m, 0.0)
