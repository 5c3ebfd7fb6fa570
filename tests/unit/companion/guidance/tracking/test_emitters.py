"""Several emitters: a filter each, and one after the other."""

from __future__ import annotations

import math

import msgspec
import pytest

from companion.domain import RangingMeasurement, VehicleState
from companion.estimation.screen import RejectReason
from companion.estimation.stepwise import finish
from companion.estimation.tracker import FusionReport, TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.geometry.polygons import Point
from companion.guidance.emitters import (
    LOST_S,
    MIN_ACCEPTED,
    EmitterQueue,
    Order,
    Progress,
    QueueParams,
)
from companion.guidance.measurements import Queued, RangingListener
from companion.guidance.vehicle_track import VehicleTrack

EMITTERS_ENU_M: dict[int, Point] = {1: (80.0, 0.0), 2: (30.0, 0.0), 3: (0.0, 50.0)}
HERE = (0.0, 0.0, 20.0)


def fused(queue: EmitterQueue, measurement: RangingMeasurement, now_s: float) -> FusionReport:
    """A measurement that was taken here."""
    track = VehicleTrack()
    track.add(VehicleState(measurement.measured_at_s, HERE, (0.0, 0.0, 0.0)))
    return finish(RangingListener(queue, track).fusion(Queued(measurement, now_s, None)))


class Heard:
    """A queue, and a radio that measures the emitters of given ids."""

    def __init__(
        self, order: Order, listed: tuple[int, ...] = (), *, searches_on: bool = False
    ) -> None:
        self.queue = EmitterQueue(
            TrackerParams(), QueueParams(order=order, listed=listed), searches_on=searches_on
        )
        self.now_s = 0.0

    def hear(
        self, *ids: int, times: int = 1, is_flying: bool = False, quality: float | None = None
    ) -> list[FusionReport]:
        reports = []
        for _ in range(times):
            self.now_s += 0.1
            for number in ids:
                east, north = EMITTERS_ENU_M[number]
                measurement = RangingMeasurement(
                    emitter_id=number,
                    measured_at_s=self.now_s,
                    range_m=math.dist((east, north, 0.0), HERE),
                    range_sigma_m=1.0,
                    bearing_enu_rad=math.atan2(north, east),
                    bearing_sigma_rad=0.03,
                    quality=None if quality is None else quality / number,
                )
                reports.append(fused(self.queue, measurement, self.now_s))
                self.queue.choose(self.now_s, is_flying=is_flying)
        return reports

    @property
    def current(self) -> int | None:
        return self.queue.current.emitter_id


def test_first_is_what_it_was_one_emitter_and_no_other() -> None:
    heard = Heard("first")
    heard.hear(3, times=2)
    (report,) = heard.hear(1)
    assert report.reject_reason is RejectReason.OTHER_EMITTER
    assert heard.current == 3
    assert heard.queue.trackers == (heard.queue.current,)
    assert not heard.queue.report_current()
    assert heard.queue.is_single


def test_a_queue_of_one_is_its_tracker() -> None:
    tracker = TargetTracker(TrackerParams(), 5)
    assert EmitterQueue.of(tracker).current is tracker


@pytest.mark.parametrize(("order", "expected"), [("nearest", [2, 3, 1]), ("strongest", [2, 3, 1])])
def test_each_has_its_turn_and_learns_while_it_waits(order: Order, expected: list[int]) -> None:
    heard = Heard(order)
    heard.hear(1, 2, 3, times=20)
    turns = [heard.current]
    while heard.queue.report_current():
        turns.append(heard.current)
    assert turns == expected
    assert all(tracker.accepted == 20 for tracker in heard.queue.trackers)
    assert heard.queue.reported == {1, 2, 3}
    assert heard.queue.waiting == []


def test_strength_is_what_the_radio_says_if_it_says_anything() -> None:
    heard = Heard("strongest")
    heard.hear(1, 2, 3, times=20, quality=0.9)
    assert heard.current == 1
    assert heard.queue.waiting == [2, 3]


def test_the_strongest_is_the_one_of_most_received_power() -> None:
    heard = Heard("strongest")
    for number, power_dbm in [(1, -80.0), (2, -60.0), (3, -70.0)] * MIN_ACCEPTED:
        heard.now_s += 0.1
        measurement = RangingMeasurement(number, heard.now_s, power_dbm=power_dbm)
        fused(heard.queue, measurement, heard.now_s)
        heard.queue.choose(heard.now_s, is_flying=False)
    assert heard.current == 2
    assert heard.queue.waiting == [3, 1]


def test_listed_emitters_come_in_their_order_and_others_never() -> None:
    heard = Heard("listed", (3, 1))
    reports = heard.hear(1, 2, 3, times=10)
    assert [r.reject_reason for r in reports[:3]] == [None, RejectReason.OTHER_EMITTER, None]
    assert heard.current == 3
    assert heard.queue.waiting == [1]


def test_a_listed_emitter_is_looked_for_before_it_is_heard() -> None:
    heard = Heard("listed", (3, 1))
    assert heard.current == 3
    assert heard.queue.current.last_accepted_s is None
    heard.hear(1, times=10)
    assert heard.current == 1
    assert heard.queue.waiting == [3]


def test_in_flight_the_current_one_stays_though_another_is_nearer() -> None:
    heard = Heard("nearest")
    heard.hear(1, times=10)
    heard.hear(2, times=10, is_flying=True)
    assert heard.current == 1
    heard.hear(2)
    assert heard.current == 2


def test_one_that_is_lost_in_flight_waits_behind_those_that_are_heard() -> None:
    heard = Heard("nearest")
    heard.hear(1, 2, 3, times=10)
    assert heard.current == 2
    heard.hear(1, times=round(10 * LOST_S) + 2, is_flying=True)
    assert heard.current == 1
    assert heard.queue.waiting == [3, 2]


def test_one_that_is_lost_alone_stays_current() -> None:
    heard = Heard("nearest")
    heard.hear(2, times=10)
    heard.now_s += 2 * LOST_S
    heard.hear(2, is_flying=True)
    assert heard.current == 2


def test_strangers_cannot_make_filters_without_end() -> None:
    heard = Heard("nearest")
    for number in range(QueueParams.most):
        fused(heard.queue, ranging(number), heard.now_s)
    report = fused(heard.queue, ranging(QueueParams.most), heard.now_s)
    assert report.reject_reason is RejectReason.OTHER_EMITTER
    assert len(heard.queue.trackers) == QueueParams.most


def ranging(emitter_id: int) -> RangingMeasurement:
    return RangingMeasurement(emitter_id=emitter_id, measured_at_s=0.0, range_m=40.0)


def test_absurd_measurements_of_a_stranger_get_no_filter() -> None:
    heard = Heard("nearest")
    heard.hear(1)
    absurd = RangingMeasurement(emitter_id=9, measured_at_s=heard.now_s, range_m=-5.0)
    report = fused(heard.queue, absurd, heard.now_s)
    assert report.reject_reason not in (None, RejectReason.OTHER_EMITTER)
    assert [tracker.emitter_id for tracker in heard.queue.trackers] == [1]


def test_in_flight_one_that_was_never_heard_gives_way() -> None:
    heard = Heard("listed", (3, 1))
    heard.hear(1, is_flying=True)
    assert heard.current == 1


def test_what_was_counted_before_the_first_emitter_is_not_lost() -> None:
    heard = Heard("nearest")
    heard.queue.current.reject(RejectReason.TOO_MANY)
    heard.hear(1, 2, times=3)
    heard.hear(1)
    heard.queue.trackers[1].reject(RejectReason.STALE)
    assert heard.queue.accepted == 7
    assert heard.queue.rejected == {RejectReason.TOO_MANY: 1, RejectReason.STALE: 1}
    assert heard.queue.restarts == 0


def test_a_moved_frame_is_forgotten_by_all() -> None:
    heard = Heard("nearest")
    heard.hear(1, 2, times=10)
    heard.queue.restart()
    assert all(tracker.estimate(9.0) is None for tracker in heard.queue.trackers)
    assert heard.queue.current.reject(RejectReason.STALE).reject_reason is RejectReason.STALE


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        ({"order": "listed"}, "needs ids"),
        ({"order": "nearest", "listed": [1]}, "nearest and strongest need none"),
        ({"order": "listed", "listed": [1, 1]}, "listed twice"),
        ({"listed": [1, 2]}, "first searches for one emitter"),
        ({"order": "listed", "listed": list(range(17))}, "length <= 16"),
        ({"order": "best"}, "Invalid enum value"),
    ],
)
def test_orders_that_make_no_sense_are_refused(fields: dict[str, object], complaint: str) -> None:
    with pytest.raises(msgspec.ValidationError, match=complaint):
        msgspec.convert(fields, QueueParams)


def test_a_search_that_goes_on_waits_for_another_and_masks_those_reported() -> None:
    heard = Heard("nearest", searches_on=True)
    heard.hear(2, times=10)
    assert heard.queue.report_current()
    assert heard.current is None
    assert heard.queue.progress == Progress((2,), (), ())
    heard.hear(2, times=10, is_flying=True)
    assert heard.current is None
    assert not heard.queue.is_current(2)
    heard.hear(2, times=10)
    assert heard.current is None
    heard.hear(1, times=10, is_flying=True)
    assert heard.current == 1
    assert heard.queue.progress == Progress((2,), (1,), ())
    assert heard.queue.report_current()
    assert not heard.queue.are_all_reported


def test_a_search_that_goes_on_ends_where_no_filter_is_left_for_another() -> None:
    heard = Heard("nearest", searches_on=True)
    for number in range(QueueParams.most):
        fused(heard.queue, ranging(number), heard.now_s)
    turns = [heard.queue.report_current() for _ in range(QueueParams.most)]
    assert turns == [True] * (QueueParams.most - 1) + [False]
    assert heard.queue.progress.sought is None
    assert heard.queue.are_all_reported


def test_a_report_of_before_is_masked_though_it_was_heard_again_first() -> None:
    heard = Heard("nearest", searches_on=True)
    heard.hear(2, times=10)
    belief = heard.queue.current.belief
    assert belief is not None
    heard.queue.mark_reported([2])
    assert heard.current is None
    assert heard.queue.resume(belief, 5.0, heard.now_s) is None
    assert heard.current is None


def test_listed_ids_are_sought_until_each_is_heard() -> None:
    heard = Heard("listed", (3, 1))
    assert heard.queue.progress.sought == (3, 1)
    heard.hear(1, times=2)
    assert heard.queue.progress == Progress((), (1,), (3,))
    heard.hear(3)
    assert heard.queue.progress.sought is None


def test_one_emitter_is_sought_until_it_is_heard() -> None:
    heard = Heard("first")
    assert heard.queue.progress.sought == ()
    heard.hear(3)
    assert heard.queue.progress == Progress((), (3,), None)
