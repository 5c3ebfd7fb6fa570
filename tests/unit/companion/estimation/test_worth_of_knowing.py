"""Missing, stale, lost or wrong inputs are counted, and never make R95 better.

A two-axis array that looks down passes an emitter three times, 20 m above it. What a case changes
is the same from `SPOILT_FROM_S` on, or all the time; the noise is the same in all of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from companion.domain import (
    GNSS_ACCURACY_FACTOR,
    Attitude,
    EstimateState,
    PositionAccuracy,
    RangingMeasurement,
    TargetEstimate,
)
from companion.estimation.antenna import AntennaKind, AntennaParams, antenna_axes_enu, seen_in_enu
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.screen import RejectReason
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams

DOWN = (0.0, -90.0, 0.0)
TARGET, HEIGHT_M = (20.0, 10.0, 0.0), 20.0
LEGS, PER_LEG = ((0.3, 1.0), (1.9, -2.0), (2.8, 1.5)), 30
SPOILT_FROM_S = 6.0
SIGMA_RAD = math.radians(3.0)
RTK, LOST = PositionAccuracy(0.02, 0.04, is_reported=True), PositionAccuracy()

Known = Callable[[float, Attitude], Attitude | None]


def as_it_is(_time_s: float, attitude: Attitude) -> Attitude | None:
    return attitude


def without_tilt(time_s: float, attitude: Attitude) -> Attitude | None:
    return attitude if time_s < SPOILT_FROM_S else Attitude(attitude.yaw_ned_rad)


def without_any(time_s: float, attitude: Attitude) -> Attitude | None:
    return attitude if time_s < SPOILT_FROM_S else None


def search(
    known: Known = as_it_is,
    mounted_deg: tuple[float, float, float] = DOWN,
    lost_from_s: float = math.inf,
    before: PositionAccuracy = RTK,
    kind: AntennaKind = "two_axis",
) -> tuple[TargetTracker, TargetEstimate]:
    antenna = AntennaParams(kind="two_axis", mount_deg=DOWN)
    believed = FilterParams(
        antenna=AntennaParams(kind=kind, mount_deg=DOWN),
        range_sigma_m=0.5,
        bearing_sigma_deg=3.0,
        bearing_offset_max_deg=15.0,
    )
    tracker, rng = TargetTracker(TrackerParams(filter=believed)), np.random.default_rng(5)
    for index in range(len(LEGS) * PER_LEG):
        course, aside_m = LEGS[index // PER_LEG]
        along_m, time_s = 30.0 - 2.0 * (index % PER_LEG), 0.4 * index
        cos, sin = math.cos(course), math.sin(course)
        east = TARGET[0] + along_m * cos - aside_m * sin
        north = TARGET[1] + along_m * sin + aside_m * cos
        position = (east, north, HEIGHT_M)
        roll, pitch = rng.normal(0.0, 0.1, 2).tolist()
        attitude = Attitude(-0.5 * math.pi - course, (roll, pitch))
        axes = antenna_axes_enu((roll, pitch, attitude.yaw_ned_rad), mounted_deg)
        to = np.array(TARGET) - position
        slant_m = float(np.linalg.norm(to))
        _, y, z = np.array(axes) @ to / slant_m + SIGMA_RAD * rng.standard_normal(3)
        printed = RangingMeasurement(
            emitter_id=1,
            measured_at_s=time_s,
            range_m=slant_m + 0.5 * rng.standard_normal(),
            bearing_body_rad=math.asin(max(-1.0, min(1.0, y))),
            elevation_rad=math.asin(max(-1.0, min(1.0, -z))),
            is_array_angle=True,
        )
        own = before if time_s < lost_from_s else LOST
        tracker.fuse(seen_in_enu(printed, known(time_s, attitude), antenna), position, time_s, own)
    estimate = tracker.estimate(time_s)
    assert estimate is not None
    return tracker, estimate


@pytest.fixture(scope="module")
def undisturbed() -> TargetEstimate:
    tracker, estimate = search()
    assert tracker.rejected.total() == 0
    assert tracker.identified_antenna is None
    assert estimate.state is EstimateState.LOCALISED
    assert math.dist(estimate.position_enu_m, TARGET[:2]) < estimate.r95_m < 1.0
    return estimate


@pytest.mark.parametrize("known", [without_tilt, without_any])
def test_an_attitude_that_is_missing_is_counted_and_r95_is_wider(
    known: Known, undisturbed: TargetEstimate
) -> None:
    tracker, estimate = search(known)
    spoilt = len(LEGS) * PER_LEG - round(SPOILT_FROM_S / 0.4)
    assert tracker.rejected == {RejectReason.NO_ATTITUDE: spoilt}
    assert estimate.r95_m > undisturbed.r95_m
    assert estimate.absolute_r95_m > undisturbed.absolute_r95_m


@pytest.mark.slow
@pytest.mark.parametrize("mounted_deg", [(0.0, 0.0, 0.0), (0.0, -90.0, 90.0), (0.0, -50.0, 0.0)])
def test_a_mount_that_contradicts_the_measurements_is_not_believed(
    mounted_deg: tuple[float, float, float], undisturbed: TargetEstimate
) -> None:
    tracker, estimate = search(mounted_deg=mounted_deg)
    assert tracker.identified_antenna == "contradicted"
    assert max(tracker.health.inflation[1:]) > 16.0
    assert estimate.r95_m > 1.5 * undisturbed.r95_m


@pytest.mark.parametrize("lost_from_s", [0.0, 12.0, 30.0])
def test_a_fix_that_is_lost_widens_both_radii(
    lost_from_s: float, undisturbed: TargetEstimate
) -> None:
    _, estimate = search(lost_from_s=lost_from_s)
    assert not estimate.own.is_reported
    assert estimate.r95_m > undisturbed.r95_m
    assert estimate.absolute_r95_m > 2.4 * LOST.horizontal_m > undisturbed.absolute_r95_m


def test_an_accuracy_of_zero_counts_as_not_reported(undisturbed: TargetEstimate) -> None:
    """As the receiver's 0 is read; and no reported accuracy is worse than that by its name."""
    _, unreported = search(before=LOST)
    _, poor = search(before=PositionAccuracy(2.0, 4.0, is_reported=True))
    assert undisturbed.absolute_r95_m < poor.absolute_r95_m
    assert unreported.absolute_r95_m > 2.4 * LOST.horizontal_m
    assert unreported.r95_m > undisturbed.r95_m


def test_a_receiver_that_knows_its_height_badly_widens_r95_where_no_antenna_is_reported() -> None:
    _, level = search(before=PositionAccuracy(1.0, 0.0, is_reported=True), kind="auto")
    _, poor = search(before=PositionAccuracy(1.0, 6.0, is_reported=True), kind="auto")
    assert poor.r95_m > level.r95_m
    assert poor.position_enu_m == level.position_enu_m


def test_a_receiver_may_stand_between_walls_where_no_antenna_is_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    own = PositionAccuracy(1.0, 0.0, is_reported=True)
    (_, printed), (_, walls) = search(before=own), search(before=own, kind="auto")
    (_, fixed) = search(kind="auto")
    monkeypatch.setattr(
        "companion.estimation.window.shared_errors.URBAN_GNSS_RATIO", GNSS_ACCURACY_FACTOR
    )
    assert search(before=own)[1] == printed
    assert search(kind="auto")[1] == fixed
    _, sky = search(before=own, kind="auto")
    assert sky.r95_m < walls.r95_m
    assert sky.settled_r95_m == walls.settled_r95_m
    assert sky.position_enu_m == walls.position_enu_m
