"""Measurements are fused a few steps at a time, and come to the same as all at once."""

from __future__ import annotations

import pytest

from companion.domain import RangingMeasurement
from companion.estimation.stepwise import Steps, finish
from companion.estimation.tracker import FusionReport, TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.guidance.measurements import (
    BEGIN_ROWS,
    MAX_QUEUED,
    WAKE_ROWS,
    FusionQueue,
    Queued,
)


class Worker:
    """Fuses in steps of a full window, and notes which."""

    def __init__(self, steps: int = 3) -> None:
        self.noted: list[tuple[int, float]] = []
        self._steps = steps
        self.queue = FusionQueue(self.begin)

    def begin(self, queued: Queued) -> Steps[FusionReport]:
        """Note every step."""
        for _ in range(self._steps):
            self.noted.append((queued.measurement.emitter_id, queued.now_s))
            yield WAKE_ROWS
        return FusionReport(None)

    def add(self, emitter_id: int, now_s: float) -> bool:
        """Queue a measurement that is made now."""
        return self.queue.add(Queued(RangingMeasurement(emitter_id, now_s, 5.0), now_s, None))

    def wake(self, first_id: int | None = None) -> int:
        """Go on; return how many measurements were finished."""
        self.queue.left = WAKE_ROWS
        return len(self.queue.advance(first_id))


def test_a_wake_up_makes_one_large_step_and_no_other() -> None:
    worker = Worker()
    worker.add(1, 0.0)
    assert worker.wake() == 0
    assert worker.queue.advance(None) == []
    assert len(worker.noted) == 1
    assert [worker.wake() for _ in range(3)] == [0, 0, 1]
    assert len(worker.queue) == 0


def test_small_steps_share_a_wake_up() -> None:
    worker = Worker(steps=0)
    for number in range(10):
        worker.add(1, float(number))
    assert worker.wake() == WAKE_ROWS // BEGIN_ROWS


def test_measurements_of_an_emitter_stay_in_order() -> None:
    worker = Worker()
    for now_s in (0.0, 1.0, 2.0):
        worker.add(1, now_s)
    while len(worker.queue):
        worker.wake()
    assert [now_s for _, now_s in worker.noted] == [0.0] * 3 + [1.0] * 3 + [2.0] * 3


def test_the_emitter_that_is_looked_for_goes_first() -> None:
    worker = Worker()
    worker.add(1, 0.0)
    worker.wake()
    worker.add(2, 0.1)
    worker.wake(first_id=2)
    assert worker.noted == [(1, 0.0), (2, 0.1)]


def test_the_others_take_turns() -> None:
    worker = Worker(steps=1)
    for now_s in (0.0, 1.0):
        for emitter_id in (1, 2, 3):
            worker.add(emitter_id, now_s)
    while len(worker.queue):
        worker.wake()
    assert [emitter_id for emitter_id, _ in worker.noted] == [1, 2, 3, 1, 2, 3]


def test_of_too_many_the_oldest_that_is_not_begun_gives_way() -> None:
    worker = Worker()
    assert not any(worker.add(1, float(number)) for number in range(MAX_QUEUED))
    worker.wake()
    assert worker.add(1, 999.0)
    assert len(worker.queue) == MAX_QUEUED
    while len(worker.queue):
        worker.wake()
    seen = list(dict.fromkeys(now_s for _, now_s in worker.noted))
    assert seen == [0.0, *(float(number) for number in range(2, MAX_QUEUED)), 999.0]


@pytest.mark.parametrize("is_begun", [True, False])
def test_more_emitters_than_places_leave_none_without_a_measurement(is_begun: bool) -> None:
    """As forged ids do: each has one measurement, and none that is begun is lost."""
    worker = Worker(steps=1)
    worker.add(0, 0.0)
    if is_begun:
        worker.wake()
    for number in range(1, 2 * MAX_QUEUED):
        worker.add(number, float(number))
    assert len(worker.queue) == MAX_QUEUED
    finished = sum(worker.wake() for _ in range(4 * MAX_QUEUED))
    assert finished == MAX_QUEUED
    assert len(worker.queue) == 0
    assert ((0, 0.0) in worker.noted) is is_begun
    assert (2 * MAX_QUEUED - 1, 2.0 * MAX_QUEUED - 1.0) in worker.noted


def test_what_makes_a_filter_fail_is_not_tried_again() -> None:
    def fail(queued: Queued) -> Steps[FusionReport]:
        yield 0
        raise ValueError(queued)

    queue = FusionQueue(fail)
    queue.add(Queued(RangingMeasurement(1, 0.0, 5.0), 0.0, None))
    with pytest.raises(ValueError, match="RangingMeasurement"):
        queue.advance(None)
    assert len(queue) == 0


def test_a_move_of_the_frame_gives_a_begun_solution_up() -> None:
    tracker = TargetTracker(TrackerParams())
    for number in range(40):
        position = (float(number), 3.0 * (number % 7), 10.0)
        measurement = RangingMeasurement(1, 0.1 * number, 30.0 + 0.5 * number, 1.0)
        steps = tracker.fusion(measurement, position, 0.1 * number)
        if next(steps, None) is not None and tracker.accepted > 20:
            break
        finish(steps)
    next(steps)  # the first start of the solution is solved
    before = tracker.hypotheses[0].state.mean[:2].tolist()
    tracker.move((5.0, -2.0, 0.0), 0.0)
    assert finish(steps).reject_reason is None
    after = tracker.hypotheses[0].state.mean[:2].tolist()
    assert after == pytest.approx([before[0] + 5.0, before[1] - 2.0])
