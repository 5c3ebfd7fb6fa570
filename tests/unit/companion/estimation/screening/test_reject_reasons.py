"""Measurements that are refused, and leave no trace."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.screen import FUTURE_TOLERANCE_S, RejectReason
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams

POSITION: PositionEnu = (10.0, 5.0, 20.0)
NOW_S = 100.0
GOOD = RangingMeasurement(
    emitter_id=7,
    measured_at_s=NOW_S,
    range_m=50.0,
    range_sigma_m=1.0,
    bearing_enu_rad=0.4,
    bearing_sigma_rad=0.03,
    stamp_us=1_000,
)

UNSTAMPED = replace(GOOD, measured_at_s=NOW_S - 0.8, stamp_us=None)


def _tracker() -> TargetTracker:
    """A tracker in flight, with emitter 7, stamps up to 999 and one without behind it."""
    tracker = TargetTracker(TrackerParams())
    tracker.fuse(UNSTAMPED, (-10.0, 0.0, 20.0), NOW_S - 0.5)
    for step in range(5):
        seen = replace(GOOD, measured_at_s=NOW_S - 1.0 + 0.1 * step, stamp_us=995 + step)
        tracker.fuse(seen, (10.0 * step, 0.0, 20.0), NOW_S - 0.5)
    return tracker


def _snapshot(tracker: TargetTracker) -> list[object]:
    """Return all state that a measurement could have changed, bit by bit."""
    return [
        *[
            (h.log_weight, h.state.time_s, h.state.mean.tobytes(), h.state.covariance.tobytes())
            for h in tracker.hypotheses
        ],
        tracker.estimate(NOW_S),
        tracker.health.inflation,
        tracker.health.nlos_share,
        tracker.accepted,
        tracker.integrity.restarts,
        tracker.last_accepted_s,
        tracker.emitter_id,
    ]


REFUSED = {
    "other emitter": (replace(GOOD, emitter_id=8), RejectReason.OTHER_EMITTER),
    "nothing": (replace(GOOD, range_m=None, bearing_enu_rad=None), RejectReason.NOTHING_MEASURED),
    "range NaN": (replace(GOOD, range_m=math.nan), RejectReason.NOT_FINITE),
    "range inf": (replace(GOOD, range_m=math.inf), RejectReason.NOT_FINITE),
    "range -inf": (replace(GOOD, range_m=-math.inf), RejectReason.NOT_FINITE),
    "bearing NaN": (replace(GOOD, bearing_enu_rad=math.nan), RejectReason.NOT_FINITE),
    "bearing inf": (replace(GOOD, bearing_enu_rad=math.inf), RejectReason.NOT_FINITE),
    "body bearing NaN": (replace(GOOD, bearing_body_rad=math.nan), RejectReason.NOT_FINITE),
    "sigma NaN": (replace(GOOD, range_sigma_m=math.nan), RejectReason.NOT_FINITE),
    "bearing sigma inf": (replace(GOOD, bearing_sigma_rad=math.inf), RejectReason.NOT_FINITE),
    "time NaN": (replace(GOOD, measured_at_s=math.nan), RejectReason.NOT_FINITE),
    "range negative": (replace(GOOD, range_m=-1.0), RejectReason.RANGE_NOT_POSITIVE),
    "range zero": (replace(GOOD, range_m=0.0), RejectReason.RANGE_NOT_POSITIVE),
    "range absurd": (replace(GOOD, range_m=2000.1), RejectReason.RANGE_ABSURD),
    "bearing in degrees": (replace(GOOD, bearing_enu_rad=90.0), RejectReason.BEARING_ABSURD),
    "body bearing in degrees": (replace(GOOD, bearing_body_rad=-7.0), RejectReason.BEARING_ABSURD),
    "bearing past half a turn": (replace(GOOD, bearing_enu_rad=3.15), RejectReason.BEARING_ABSURD),
    "body bearing past half a turn": (
        replace(GOOD, bearing_body_rad=-3.15),
        RejectReason.BEARING_ABSURD,
    ),
    "range denormal": (replace(GOOD, range_m=1e-40), RejectReason.DENORMAL),
    "range the least of 64 bits": (replace(GOOD, range_m=5e-324), RejectReason.DENORMAL),
    "bearing denormal": (replace(GOOD, bearing_enu_rad=-1e-39), RejectReason.DENORMAL),
    "sigma denormal": (replace(GOOD, range_sigma_m=1e-300), RejectReason.DENORMAL),
    "elevation NaN": (replace(GOOD, elevation_rad=math.nan), RejectReason.NOT_FINITE),
    "elevation inf": (replace(GOOD, elevation_rad=math.inf), RejectReason.NOT_FINITE),
    "elevation sigma NaN": (replace(GOOD, elevation_sigma_rad=math.nan), RejectReason.NOT_FINITE),
    "elevation in degrees": (replace(GOOD, elevation_rad=45.0), RejectReason.ELEVATION_ABSURD),
    "elevation past the zenith": (replace(GOOD, elevation_rad=1.6), RejectReason.ELEVATION_ABSURD),
    "elevation alone": (
        replace(GOOD, range_m=None, bearing_enu_rad=None, elevation_rad=0.3),
        RejectReason.NOTHING_MEASURED,
    ),
    "sigma zero": (replace(GOOD, range_sigma_m=0.0), RejectReason.SIGMA_NOT_POSITIVE),
    "elevation sigma zero": (
        replace(GOOD, elevation_sigma_rad=0.0),
        RejectReason.SIGMA_NOT_POSITIVE,
    ),
    "bearing sigma negative": (
        replace(GOOD, bearing_sigma_rad=-0.1),
        RejectReason.SIGMA_NOT_POSITIVE,
    ),
    "future": (
        replace(GOOD, measured_at_s=NOW_S + FUTURE_TOLERANCE_S + 0.01),
        RejectReason.FROM_THE_FUTURE,
    ),
    "stale": (replace(GOOD, measured_at_s=NOW_S - 1.01), RejectReason.STALE),
    "duplicate": (replace(GOOD, stamp_us=997), RejectReason.DUPLICATE),
    "duplicate without a stamp": (UNSTAMPED, RejectReason.DUPLICATE),
    "no yaw for the bearing of an elevation": (
        replace(GOOD, range_m=None, bearing_enu_rad=None, bearing_body_rad=0.1, elevation_rad=-0.3),
        RejectReason.NO_YAW,
    ),
    "no yaw": (
        replace(GOOD, range_m=None, bearing_enu_rad=None, bearing_body_rad=0.1),
        RejectReason.NO_YAW,
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_refused_is_counted_and_changes_nothing(name: str) -> None:
    measurement, reason = REFUSED[name]
    tracker = _tracker()
    before = _snapshot(tracker)
    report = tracker.fuse(measurement, POSITION, NOW_S)
    assert report.reject_reason is reason
    assert report.update is None
    assert not report.restarted
    assert tracker.rejected == {reason: 1}
    assert _snapshot(tracker) == before


@pytest.mark.parametrize("position", [None, (math.nan, 0.0, 0.0), (0.0, 0.0, math.inf)])
def test_without_an_own_position_it_is_refused(position: PositionEnu | None) -> None:
    tracker = _tracker()
    before = _snapshot(tracker)
    assert tracker.fuse(GOOD, position, NOW_S).reject_reason is RejectReason.NO_POSITION
    assert tracker.rejected == {RejectReason.NO_POSITION: 1}
    assert _snapshot(tracker) == before


@pytest.mark.parametrize("name", REFUSED)
def test_what_was_refused_leaves_no_trace_in_what_follows(name: str) -> None:
    disturbed, calm = _tracker(), _tracker()
    for step in range(5):
        seen = replace(GOOD, measured_at_s=NOW_S + 0.05 * step, stamp_us=2_000 + step)
        disturbed.fuse(REFUSED[name][0], POSITION, NOW_S)
        disturbed.fuse(seen, POSITION, NOW_S + 0.2)
        calm.fuse(seen, POSITION, NOW_S + 0.2)
    assert _snapshot(disturbed) == _snapshot(calm)


def test_every_reason_is_covered_here() -> None:
    covered = {reason for _, reason in REFUSED.values()} | {RejectReason.NO_POSITION}
    judged_beside_others = {
        RejectReason.RANGE_OUTLIER,
        RejectReason.BEARING_OUTLIER,
        RejectReason.TOO_MANY,
        RejectReason.FROZEN,
        RejectReason.WRONG_UNIT,
        RejectReason.OWN_JUMP,
    }
    of_arrays = {  # see `test_antenna`
        RejectReason.NO_ATTITUDE,
        RejectReason.NO_ANTENNA,
        RejectReason.BY_NORTH,
        RejectReason.OUT_OF_VIEW,
    }
    of_power = {RejectReason.POWER_ABSURD, RejectReason.POWER_OUTLIER}  # `test_received_power`
    assert covered == set(RejectReason) - judged_beside_others - of_arrays - of_power


@pytest.mark.parametrize(
    "edge",
    [
        GOOD,
        replace(GOOD, range_m=1e-6),
        replace(GOOD, range_m=2000.0),
        replace(GOOD, range_m=None),
        replace(GOOD, bearing_enu_rad=None),
        replace(GOOD, bearing_enu_rad=float(np.float32(-math.pi))),
        replace(GOOD, measured_at_s=NOW_S - 1.0),
        replace(GOOD, measured_at_s=NOW_S + 0.5 * FUTURE_TOLERANCE_S),
        replace(GOOD, stamp_us=None),
        replace(GOOD, elevation_rad=float(np.float32(0.5 * math.pi))),
        replace(GOOD, elevation_rad=float(np.float32(-0.5 * math.pi))),
        replace(GOOD, range_sigma_m=1e-37, bearing_sigma_rad=1e300),
        replace(GOOD, bearing_enu_rad=0.0),
    ],
)
def test_what_is_just_plausible_is_accepted(edge: RangingMeasurement) -> None:
    tracker = _tracker()
    assert tracker.fuse(edge, POSITION, NOW_S).reject_reason is None
    assert tracker.accepted == 7


def test_without_stamps_the_time_of_measurement_tells_a_duplicate() -> None:
    tracker = _tracker()
    unstamped = replace(GOOD, stamp_us=None)
    later = replace(unstamped, measured_at_s=NOW_S + 0.01)
    assert tracker.fuse(unstamped, POSITION, NOW_S).reject_reason is None
    assert tracker.fuse(unstamped, POSITION, NOW_S).reject_reason is RejectReason.DUPLICATE
    assert tracker.fuse(later, POSITION, NOW_S).reject_reason is None
    assert tracker.fuse(unstamped, POSITION, NOW_S).reject_reason is RejectReason.DUPLICATE


def test_an_elevation_whose_bearing_lacks_a_yaw_starts_nothing() -> None:
    tracker = TargetTracker(TrackerParams())
    seen = RangingMeasurement(1, NOW_S, bearing_body_rad=0.1, elevation_rad=-0.3)
    assert tracker.fuse(seen, POSITION, NOW_S).reject_reason is RejectReason.NO_YAW
    assert tracker.estimate(NOW_S) is None


def test_a_refused_measurement_does_not_choose_the_emitter() -> None:
    tracker = TargetTracker(TrackerParams())
    tracker.fuse(replace(GOOD, emitter_id=3, range_m=math.nan), POSITION, NOW_S)
    tracker.fuse(replace(GOOD, emitter_id=4), None, NOW_S)
    assert tracker.emitter_id is None
    tracker.fuse(GOOD, POSITION, NOW_S)
    assert tracker.emitter_id == 7


def test_range_and_bearing_of_one_moment_are_no_duplicates_of_each_other() -> None:
    tracker = _tracker()
    both = replace(GOOD, bearing_enu_rad=0.5, stamp_us=77)
    assert tracker.fuse(replace(both, bearing_enu_rad=None), POSITION, NOW_S).reject_reason is None
    assert tracker.fuse(replace(both, range_m=None), POSITION, NOW_S).reject_reason is None
    again = tracker.fuse(replace(both, range_m=None, measured_at_s=NOW_S - 0.01), POSITION, NOW_S)
    assert again.reject_reason is RejectReason.DUPLICATE


@pytest.mark.slow
@pytest.mark.parametrize("bound", [None, 0, 7])
def test_one_emitter_is_bound_and_all_others_are_ignored_and_counted(bound: int | None) -> None:
    """Also 0, which is an id like any other; and the first one heard stays the one."""
    mixed, alone = TargetTracker(TrackerParams(), bound), TargetTracker(TrackerParams(), bound)
    ours = 0 if bound is None else bound
    for step in range(30):
        time_s, position = NOW_S + 0.1 * step, (2.0 * step, 0.0, 20.0)
        seen = replace(
            GOOD,
            emitter_id=ours,
            measured_at_s=time_s,
            stamp_us=step,
            range_m=50.0 + math.sin(step),
            bearing_enu_rad=0.4 + 0.03 * math.cos(step),
        )
        for tracker in (mixed, alone):
            assert tracker.fuse(seen, position, time_s).reject_reason is None
        for other in {0, 7, 8, 65_535} - {ours}:
            stranger = replace(seen, emitter_id=other, range_m=5.0, bearing_enu_rad=-2.0)
            assert (
                mixed.fuse(stranger, position, time_s).reject_reason is RejectReason.OTHER_EMITTER
            )
    assert mixed.emitter_id == ours
    assert mixed.rejected == {RejectReason.OTHER_EMITTER: 90}
    assert _snapshot(mixed) == _snapshot(alone)


def test_an_id_that_changes_in_flight_is_a_dropout() -> None:
    tracker = _tracker()
    for step in range(40):
        seen = replace(GOOD, emitter_id=9, measured_at_s=NOW_S + 0.1 * step, stamp_us=2_000 + step)
        assert (
            tracker.fuse(seen, POSITION, NOW_S + 0.1 * step).reject_reason
            is RejectReason.OTHER_EMITTER
        )
    assert tracker.emitter_id == 7
    assert tracker.integrity.contact.is_interrupted(NOW_S + 4.0)
