from __future__ import annotations

import math
from dataclasses import replace

import pytest

from companion.domain import Attitude, PositionEnu, RangingMeasurement, VehicleState
from companion.estimation.antenna import AntennaKind, AntennaParams
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.screen import RejectReason
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.guidance.emitters import EmitterQueue
from companion.guidance.measurements import MAX_WAITING, RangingListener
from companion.guidance.vehicle_track import VehicleTrack

PAPER = AntennaParams()
AT_10_S = RangingMeasurement(emitter_id=7, measured_at_s=10.0, range_m=50.0)


class Flight:
    """A vehicle flying east at 5 m/s, with a listener; 10 s is at the origin."""

    def __init__(self, antenna: AntennaParams = PAPER) -> None:
        self.track = VehicleTrack()
        self.tracker = TargetTracker(TrackerParams(filter=FilterParams(antenna=antenna)))
        self.listener = RangingListener(EmitterQueue.of(self.tracker), self.track)

    def moved(self, *times_s: float) -> None:
        for time_s in times_s:
            position: PositionEnu = (5.0 * (time_s - 10.0), 0.0, 20.0)
            self.track.add(VehicleState(time_s, position, (5.0, 0.0, 0.0)))

    @property
    def refusals(self) -> dict[RejectReason, int]:
        return dict(self.tracker.rejected)

    def first_fix(self) -> tuple[float, float]:
        east, north = self.tracker.hypotheses[0].state.mean[:2]
        return float(east), float(north)


@pytest.mark.parametrize(("kind", "waits"), [("azimuth", False), ("planar", True)])
def test_an_angle_of_an_array_waits_for_the_attitude_on_its_other_side(
    kind: AntennaKind, waits: bool
) -> None:
    flight = Flight(AntennaParams(kind=kind))
    flight.moved(9.9, 10.1)
    flight.track.add_attitude(9.9, Attitude(0.0, (0.0, 0.0)))
    flight.listener.receive(replace(AT_10_S, range_m=None, bearing_body_rad=0.4))
    assert (flight.listener.fuse_due(10.1) == []) is waits
    flight.track.add_attitude(10.1, Attitude(0.0, (0.4, 0.0)))
    reports = flight.listener.fuse_due(10.1)
    assert len(reports) == waits
    for report in reports:
        assert report.measurement is not None
        assert report.measurement.array is not None
        down = report.measurement.array.second_axis_enu[2]
        assert down == pytest.approx(-math.sin(0.2))  # half way between both attitudes


def test_an_angle_of_an_array_waits_for_an_attitude_no_longer_than_for_a_place() -> None:
    flight = Flight(AntennaParams(kind="planar"))
    flight.moved(9.9, 10.1)
    flight.listener.receive(replace(AT_10_S, bearing_body_rad=0.4))
    assert flight.listener.fuse_due(10.25) == []
    assert len(flight.listener.fuse_due(10.26)) == 1
    assert flight.refusals == {RejectReason.NO_ATTITUDE: 1}


@pytest.fixture
def flight() -> Flight:
    return Flight()


def test_a_measurement_with_positions_on_both_sides_is_fused_at_once(flight: Flight) -> None:
    flight.moved(9.9, 10.1)
    assert flight.listener.receive(AT_10_S) == []
    (report,) = flight.listener.fuse_due(10.1)
    assert report.reject_reason is None
    assert flight.tracker.accepted == 1
    assert flight.listener.fuse_due(10.2) == []


def test_a_newer_one_waits_for_the_position_on_its_other_side(flight: Flight) -> None:
    flight.moved(9.9)
    bearing = replace(AT_10_S, bearing_enu_rad=0.0, range_m=math.hypot(50.0, 20.0))
    flight.listener.receive(bearing)
    assert flight.listener.fuse_due(10.02) == []
    flight.track.add(VehicleState(10.1, (3.0, 0.0, 20.0), (5.0, 0.0, 0.0)))
    assert [r.reject_reason for r in flight.listener.fuse_due(10.1)] == [None]
    # Half way between -0.5 m and 3 m, not where the velocity alone would have led.
    assert flight.first_fix() == pytest.approx((51.25, 0.0))


def test_one_that_waited_long_enough_is_fused_where_the_velocity_leads(flight: Flight) -> None:
    flight.moved(9.8)
    flight.listener.receive(replace(AT_10_S, bearing_enu_rad=0.0, range_m=math.hypot(50.0, 20.0)))
    assert flight.listener.fuse_due(10.25) == []
    assert [r.reject_reason for r in flight.listener.fuse_due(10.26)] == [None]
    assert flight.first_fix() == pytest.approx((50.0, 0.0))


@pytest.mark.parametrize("known_s", [(), (9.6,), (10.2,)])
def test_one_that_waited_in_vain_is_refused(flight: Flight, known_s: tuple[float, ...]) -> None:
    flight.moved(*known_s)
    flight.listener.receive(AT_10_S)
    assert [r.reject_reason for r in flight.listener.fuse_due(10.3)] == [RejectReason.NO_POSITION]
    assert flight.refusals == {RejectReason.NO_POSITION: 1}
    assert flight.listener.fuse_due(10.4) == []


@pytest.mark.parametrize(
    ("measured_at_s", "refusal"),
    [
        (1e9, RejectReason.FROM_THE_FUTURE),
        (10.3, RejectReason.FROM_THE_FUTURE),
        (-1e9, RejectReason.STALE),
        (math.nan, RejectReason.NOT_FINITE),
        (math.inf, RejectReason.NOT_FINITE),
    ],
)
def test_one_from_a_time_that_will_not_come_does_not_wait(
    flight: Flight, measured_at_s: float, refusal: RejectReason
) -> None:
    flight.moved(9.9, 10.0)
    flight.listener.receive(replace(AT_10_S, measured_at_s=measured_at_s))
    assert [r.reject_reason for r in flight.listener.fuse_due(10.0)] == [refusal]


def test_order_of_arrival_is_kept_and_the_waiting_ones_stay(flight: Flight) -> None:
    flight.moved(9.8, 10.0)
    for time_s in (10.1, 9.9, 10.15, 9.95):
        flight.listener.receive(replace(AT_10_S, measured_at_s=time_s, stamp_us=int(time_s * 1e6)))
    assert len(flight.listener.fuse_due(10.15)) == 2
    flight.moved(10.2)
    assert len(flight.listener.fuse_due(10.2)) == 2
    assert flight.tracker.accepted == 4
    assert flight.refusals == {}


@pytest.mark.slow
@pytest.mark.parametrize("backwards", [False, True])
def test_the_oldest_gives_way_when_too_many_wait(flight: Flight, backwards: bool) -> None:
    times_s = [10.0 + step * 1e-3 for step in range(MAX_WAITING + 1)]
    reports = []
    for time_s in reversed(times_s) if backwards else times_s:
        reports += flight.listener.receive(replace(AT_10_S, measured_at_s=time_s))
    assert [report.reject_reason for report in reports] == [RejectReason.TOO_MANY]
    flight.moved(10.0, 10.2)
    assert len(flight.listener.fuse_due(10.2)) == MAX_WAITING
    assert flight.tracker.accepted == MAX_WAITING
    assert flight.refusals == {RejectReason.TOO_MANY: 1}


def test_a_burst_of_three_seconds_leaves_what_is_fresh(flight: Flight) -> None:
    """Return a fast radio's measurements, all at once; the position of each is known."""
    flight.moved(*(10.0 + 0.1 * step for step in range(31)))
    refused = []
    for step in range(150):
        seen = replace(AT_10_S, measured_at_s=10.0 + 0.02 * step, range_m=50.0 + 1e-3 * step)
        refused += flight.listener.receive(seen)
    reports = flight.listener.fuse_due(13.0)
    assert len(refused) + len(reports) == 150
    assert len(reports) == MAX_WAITING
    fused = [report for report in reports if report.reject_reason is None]
    assert len(fused) == flight.tracker.accepted == 50  # not older than a second
    assert set(flight.refusals) == {RejectReason.TOO_MANY, RejectReason.STALE}


def test_copies_of_one_that_waits_do_not_crowd_out_others(flight: Flight) -> None:
    flight.moved(9.9)
    for _ in range(5):
        for step in range(20):
            seen = replace(AT_10_S, measured_at_s=10.0 + step * 1e-3, stamp_us=step)
            flight.listener.receive(seen)
    flight.moved(10.2)
    assert [r.reject_reason for r in flight.listener.fuse_due(10.2)] == [None] * 20
    assert flight.refusals == {RejectReason.DUPLICATE: 80}


@pytest.mark.parametrize(
    ("yaw_deg", "body_deg", "east_m", "north_m"),
    [
        (0.0, 0.0, 0.0, 50.0),
        (90.0, 0.0, 50.0, 0.0),
        (90.0, 90.0, 0.0, -50.0),
        (0.0, -90.0, -50.0, 0.0),
        (170.0, 100.0, -50.0, 0.0),  # 270 degrees: over the cut
        (-170.0, -100.0, 50.0, 0.0),
        (179.0, -179.0, 0.0, 50.0),
    ],
)
def test_a_body_bearing_is_turned_by_the_yaw(
    flight: Flight, yaw_deg: float, body_deg: float, east_m: float, north_m: float
) -> None:
    flight.moved(9.9, 10.1)
    flight.track.add_attitude(9.9, Attitude(math.radians(yaw_deg)))
    flight.track.add_attitude(10.1, Attitude(math.radians(yaw_deg)))
    body = replace(AT_10_S, range_m=math.hypot(50.0, 20.0), bearing_body_rad=math.radians(body_deg))
    flight.listener.receive(body)
    assert [r.reject_reason for r in flight.listener.fuse_due(10.1)] == [None]
    assert flight.first_fix() == pytest.approx((east_m, north_m), abs=1e-9)


def test_the_yaw_is_that_of_the_measurements_time(flight: Flight) -> None:
    """While turning over south, from 170 to -170 degrees, the nose points south at half time."""
    flight.moved(9.9, 10.1)
    flight.track.add_attitude(9.9, Attitude(math.radians(170.0)))
    flight.track.add_attitude(10.1, Attitude(math.radians(-170.0)))
    flight.listener.receive(replace(AT_10_S, range_m=math.hypot(50.0, 20.0), bearing_body_rad=0.0))
    flight.listener.fuse_due(10.1)
    assert flight.first_fix() == pytest.approx((0.0, -50.0), abs=1e-9)


def test_a_body_bearing_alone_needs_the_yaw(flight: Flight) -> None:
    flight.moved(9.9, 10.1)
    flight.listener.receive(replace(AT_10_S, range_m=None, bearing_body_rad=0.3))
    assert [r.reject_reason for r in flight.listener.fuse_due(10.1)] == [RejectReason.NO_YAW]


def test_without_the_yaw_the_range_still_counts(flight: Flight) -> None:
    flight.moved(9.9, 10.1)
    flight.listener.receive(replace(AT_10_S, bearing_body_rad=0.3))
    assert [r.reject_reason for r in flight.listener.fuse_due(10.1)] == [None]
    assert len(flight.tracker.hypotheses) > 1  # a ring, not a fix


def test_a_bearing_in_the_local_frame_needs_no_yaw(flight: Flight) -> None:
    flight.moved(9.9, 10.1)
    flight.track.add_attitude(10.0, Attitude(2.0))
    both = replace(
        AT_10_S, range_m=math.hypot(50.0, 20.0), bearing_enu_rad=0.0, bearing_body_rad=1.0
    )
    flight.listener.receive(both)
    flight.listener.fuse_due(10.1)
    assert flight.first_fix() == pytest.approx((50.0, 0.0), abs=1e-9)


@pytest.mark.parametrize("body_rad", [math.inf, -math.inf, math.nan])
def test_a_body_bearing_that_is_no_number_is_refused(flight: Flight, body_rad: float) -> None:
    """The wire may carry infinities."""
    flight.moved(9.9, 10.1)
    flight.track.add_attitude(10.0, Attitude(0.0))
    flight.listener.receive(replace(AT_10_S, bearing_body_rad=body_rad))
    assert [r.reject_reason for r in flight.listener.fuse_due(10.1)] == [RejectReason.NOT_FINITE]


def test_a_body_bearing_in_degrees_is_refused(flight: Flight) -> None:
    flight.moved(9.9, 10.1)
    flight.track.add_attitude(10.0, Attitude(0.0))
    flight.listener.receive(replace(AT_10_S, bearing_body_rad=90.0))
    assert [r.reject_reason for r in flight.listener.fuse_due(10.1)] == [
        RejectReason.BEARING_ABSURD
    ]


@pytest.mark.slow
@pytest.mark.parametrize("copies", [2, 5])
def test_every_measurement_several_times_gives_the_same_estimate_byte_by_byte(
    copies: int,
) -> None:
    once, often = Flight(), Flight()
    for step in range(30):
        time_s = 10.0 + 0.1 * step
        seen = replace(
            AT_10_S,
            measured_at_s=time_s - 0.04,
            range_m=50.0 + math.sin(step),
            bearing_enu_rad=0.2 * math.cos(step),
            stamp_us=step,
        )
        for flight, count in ((once, 1), (often, copies)):
            flight.moved(time_s)
            for copy in range(count):
                late = replace(seen, measured_at_s=seen.measured_at_s + 1e-4 * copy)
                flight.listener.receive(late)  # a sender's clock is read anew each time
                flight.listener.fuse_due(time_s + 0.01 * copy)
    assert once.tracker.accepted == often.tracker.accepted >= 29
    one, other = once.tracker.hypotheses[0].state, often.tracker.hypotheses[0].state
    assert one.mean.tobytes() == other.mean.tobytes()
    assert one.covariance.tobytes() == other.covariance.tobytes()
    assert once.tracker.estimate(20.0) == often.tracker.estimate(20.0)


def test_nothing_is_measured_from_a_position_that_jumped(flight: Flight) -> None:
    flight.moved(9.9, 10.1)
    flight.track.exclude(9.95, 12.0)
    flight.listener.receive(AT_10_S)
    assert [r.reject_reason for r in flight.listener.fuse_due(10.1)] == [RejectReason.OWN_JUMP]
    assert flight.refusals == {RejectReason.OWN_JUMP: 1}
