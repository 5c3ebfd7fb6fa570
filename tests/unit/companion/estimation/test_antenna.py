"""Directions of an antenna array, with and without its kind configured in the estimator."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from companion.domain import Attitude, RangingMeasurement
from companion.estimation.antenna import AntennaKind, AntennaParams, antenna_axes_enu, seen_in_enu
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.measurement_model import jacobian, variances
from companion.estimation.screen import RejectReason
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.estimation.window.map_kernels import SIGMAS, VALUES

POSITION = (0.0, 0.0, 20.0)
LEVEL = Attitude(0.0, (0.0, 0.0))
PRINTED = RangingMeasurement(
    emitter_id=1, measured_at_s=0.0, range_m=30.0, bearing_body_rad=0.4, elevation_rad=0.2
)


def _tracker(antenna: AntennaParams) -> TargetTracker:
    return TargetTracker(TrackerParams(filter=FilterParams(antenna=antenna)))


@pytest.mark.parametrize(
    ("kind", "attitude", "is_array_angle", "bearing_rad", "reason"),
    [
        ("planar", None, False, 0.4, RejectReason.NO_ATTITUDE),
        ("two_axis", Attitude(0.0), True, 0.4, RejectReason.NO_ATTITUDE),
        ("azimuth", LEVEL, True, 0.4, RejectReason.NO_ANTENNA),
        ("planar", LEVEL, True, 0.4, RejectReason.NO_ANTENNA),
        ("line", LEVEL, True, 1.2, RejectReason.OUT_OF_VIEW),
        ("line", LEVEL, True, 1.6, RejectReason.BEARING_ABSURD),
        ("azimuth", None, False, 0.4, RejectReason.NO_YAW),
    ],
)
def test_a_direction_that_cannot_be_used_is_counted_and_its_range_stays(
    kind: AntennaKind,
    attitude: Attitude | None,
    is_array_angle: bool,
    bearing_rad: float,
    reason: RejectReason,
) -> None:
    antenna = AntennaParams(kind=kind, field_of_view_deg=120.0)
    printed = replace(PRINTED, bearing_body_rad=bearing_rad, is_array_angle=is_array_angle)
    seen = seen_in_enu(printed, attitude, antenna)
    tracker = _tracker(antenna)
    assert tracker.fuse(seen, POSITION, 0.0).reject_reason is None
    assert tracker.rejected[reason] == 1
    assert len(tracker.hypotheses) > 1  # a ring: the range alone
    alone = replace(seen, range_m=None, measured_at_s=0.5)
    assert tracker.fuse(alone, POSITION, 0.5).reject_reason is reason


def _information(kind: AntennaKind, east_m: float) -> float:
    """Return the information of one view of a position 20 m below, in 1 / (slant sigma)^2."""
    model = FilterParams(antenna=AntennaParams(kind=kind), own_position_sigma_m=0.0).model
    _, right, down = antenna_axes_enu((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    ahead = antenna_axes_enu((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))[0]
    axes = (ahead, right) if kind == "planar" else (right, tuple(-v for v in down))
    pose = np.array([east_m, 0.0, 20.0, *axes[0], *axes[1]])
    sigma = np.full(3, math.radians(3.0))
    H = jacobian(np.zeros(4), pose, model)[1, :2]
    R = variances(np.zeros((4, 4)), np.zeros(4), pose, sigma, model)[1]
    return float(H @ H / R) * (east_m**2 + 400.0) * float(sigma[0]) ** 2


@pytest.mark.parametrize(("east_m", "share"), [(40.0, 1.0), (10.0, 0.98), (1.0, 0.5), (0.3, 0.08)])
def test_right_from_above_a_planar_azimuth_says_little(east_m: float, share: float) -> None:
    """Nearer than slant times sigma to the array's normal it is not an angle any more."""
    assert _information("planar", east_m) == pytest.approx(share, rel=0.15)


@pytest.mark.parametrize("east_m", [40.0, 10.0, 1.0, 0.3])
def test_a_cosine_says_as_much_from_anywhere(east_m: float) -> None:
    """Here the axis is across the way to the target, so that nothing of it is lost."""
    assert _information("line", east_m) == pytest.approx(_across(east_m), rel=1e-6)


def _across(east_m: float) -> float:
    """Return the squared part across the line of sight of an axis along east or north."""
    _, right, _ = antenna_axes_enu((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    u = np.array([-east_m, 0.0, -20.0]) / math.hypot(east_m, 20.0)
    partial = np.array(right) - float(np.dot(right, u)) * u
    return float(partial[:2] @ partial[:2])


def test_a_direction_by_north_needs_no_attitude_of_a_level_planar_array() -> None:
    printed = RangingMeasurement(emitter_id=1, measured_at_s=0.0, bearing_enu_rad=0.7)
    seen = seen_in_enu(printed, None, AntennaParams(kind="planar"))
    assert seen.bearing_enu_rad == pytest.approx(0.7)
    assert seen.array is not None


@pytest.mark.parametrize("kind", ["line", "two_axis"])
def test_an_array_that_tells_a_direction_by_north_is_none_and_that_is_counted(
    kind: AntennaKind,
) -> None:
    antenna = AntennaParams(kind=kind)
    tracker = _tracker(antenna)
    printed = RangingMeasurement(emitter_id=1, measured_at_s=0.0, range_m=29.0, bearing_enu_rad=0.7)
    assert tracker.fuse(seen_in_enu(printed, LEVEL, antenna), POSITION, 0.0).reject_reason is None
    assert tracker.rejected == {RejectReason.BY_NORTH: 1}
    assert len(tracker.hypotheses) > 1
    alone = seen_in_enu(replace(printed, range_m=None), LEVEL, antenna)
    assert tracker.fuse(alone, POSITION, 0.0).reject_reason is RejectReason.BY_NORTH


@pytest.mark.parametrize(("elevation_rad", "is_seen"), [(0.2, True), (1.2, False), (-1.2, False)])
def test_the_field_of_view_of_a_two_axis_array_is_a_cone(
    elevation_rad: float, is_seen: bool
) -> None:
    antenna = AntennaParams(kind="two_axis", field_of_view_deg=120.0)
    printed = replace(PRINTED, elevation_rad=elevation_rad, is_array_angle=True)
    tracker = _tracker(antenna)
    tracker.fuse(seen_in_enu(printed, LEVEL, antenna), POSITION, 0.0)
    assert tracker.rejected[RejectReason.OUT_OF_VIEW] == (not is_seen)


@pytest.mark.parametrize("kind", ["planar", "line", "two_axis"])
@pytest.mark.parametrize(
    ("absurd", "reason"),
    [
        ({"elevation_rad": math.inf}, RejectReason.NOT_FINITE),
        ({"elevation_rad": 45.0}, RejectReason.ELEVATION_ABSURD),
        ({"bearing_body_rad": -math.inf}, RejectReason.NOT_FINITE),
        ({"bearing_body_rad": 40.0}, RejectReason.BEARING_ABSURD),
        ({"bearing_body_rad": None, "bearing_enu_rad": math.inf}, RejectReason.NOT_FINITE),
        ({"bearing_body_rad": None, "bearing_enu_rad": 40.0}, RejectReason.BEARING_ABSURD),
    ],
)
def test_absurd_angles_of_an_array_are_refused(
    kind: AntennaKind, absurd: dict[str, float | None], reason: RejectReason
) -> None:
    """As without one: its arithmetic would fail on infinities and believe degrees."""
    antenna = AntennaParams(kind=kind)
    seen = seen_in_enu(replace(PRINTED, **absurd), LEVEL, antenna)  # type: ignore[arg-type]
    assert _tracker(antenna).fuse(seen, POSITION, 0.0).reject_reason is reason


def test_the_elevation_of_an_array_that_is_not_configured_is_not_believed() -> None:
    printed = replace(PRINTED, is_array_angle=True)
    row = FilterParams().kernel_row(seen_in_enu(printed, LEVEL, AntennaParams()), POSITION)
    assert np.isnan(row[VALUES:SIGMAS]).tolist() == [False, True, True]


@pytest.mark.parametrize("range_m", [25.0, None])
@pytest.mark.parametrize(
    ("mount_deg", "elevation_rad", "sides"),
    [((0.0, 0.0, 0.0), -0.9, {-1.0, 1.0}), ((0.0, -90.0, 0.0), 0.5, {1.0})],
)
def test_a_two_axis_array_leaves_what_is_behind_unless_that_is_the_sky(
    mount_deg: tuple[float, float, float],
    elevation_rad: float,
    sides: set[float],
    range_m: float | None,
) -> None:
    """It prints the same of both."""
    antenna = AntennaParams(kind="two_axis", mount_deg=mount_deg)
    printed = replace(PRINTED, range_m=range_m, bearing_body_rad=0.1, elevation_rad=elevation_rad)
    seen = seen_in_enu(printed, LEVEL, antenna)  # its nose is to the north
    tracker = _tracker(antenna)
    tracker.fuse(seen, POSITION, 0.0)
    assert {math.copysign(1.0, h.position_enu_m[1]) for h in tracker.hypotheses} == sides
    bearings = [math.atan2(*h.position_enu_m[::-1]) for h in tracker.hypotheses]
    assert min(abs(b - seen.bearing_enu_rad) for b in bearings) < 1e-9  # type: ignore[operator]


def test_without_a_range_a_line_leaves_two_sides() -> None:
    antenna = AntennaParams(kind="line")
    printed = replace(PRINTED, range_m=None, elevation_rad=None)
    tracker = _tracker(antenna)
    tracker.fuse(seen_in_enu(printed, LEVEL, antenna), POSITION, 0.0)
    norths = [h.position_enu_m[1] for h in tracker.hypotheses]
    assert min(norths) < 0.0 < max(norths)
    assert all(h.position_enu_m[0] > 0.0 for h in tracker.hypotheses)


def test_what_a_planar_array_says_from_right_above_is_no_wrong_unit() -> None:
    """Bearings alone have no information on their elevation, and turn at random near the normal."""
    antenna = AntennaParams(kind="planar")
    tracker, rng = _tracker(antenna), np.random.default_rng(3)
    for index in range(120):
        at_s = 0.1 * index
        printed = RangingMeasurement(1, at_s, bearing_body_rad=float(rng.uniform(-3.1, 3.1)))
        tracker.fuse(seen_in_enu(printed, LEVEL, antenna), (0.05 * index, 0.0, 20.0), at_s)
    assert tracker.rejected[RejectReason.WRONG_UNIT] == 0
