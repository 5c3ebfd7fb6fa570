from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.link.quality import MIN_EXPECTED, SequenceMonitor

PERIOD_S = 0.02


def stream(count: int, begin: int = 0) -> list[tuple[int, float]]:
    """(sequence number, arrival) of an undisturbed sender at 50 Hz."""
    return [((begin + n) % 256, n * PERIOD_S) for n in range(count)]


def listen(frames: list[tuple[int, float]]) -> SequenceMonitor:
    monitor = SequenceMonitor()
    for sequence, now_s in frames:
        monitor.take(sequence, now_s)
    return monitor


@given(begin=st.integers(0, 255), count=st.integers(1, 1000))
def test_an_undisturbed_stream_loses_nothing_and_counts_up(begin: int, count: int) -> None:
    monitor = SequenceMonitor()
    numbers = [monitor.take(*frame) for frame in stream(count, begin)]
    assert numbers == list(range(begin, begin + count))
    assert (monitor.lost, monitor.late, monitor.duplicates) == (0, 0, 0)


@pytest.mark.parametrize("every", [2, 3, 10])
def test_a_frame_that_could_not_be_verified_is_not_lost(every: int) -> None:
    monitor = SequenceMonitor()
    for sequence, now_s in stream(1000):
        if sequence % every:
            monitor.take(sequence, now_s)
        else:
            monitor.exclude(1)
    loss = monitor.loss(999 * PERIOD_S)
    assert loss is not None
    assert loss < 0.02
    assert abs(monitor.lost) <= 1
    assert abs(monitor.received - 1000) <= 1


@pytest.mark.parametrize("loss", [0.1, 0.3, 0.5])
def test_the_share_that_is_lost_is_measured(loss: float) -> None:
    rng = random.Random(1)
    monitor, shares = SequenceMonitor(), []
    for sequence, now_s in stream(20_000):
        if rng.random() >= loss:
            monitor.take(sequence, now_s)
        share = monitor.loss(now_s)
        if share is not None:
            shares.append(share)
    assert sum(shares) / len(shares) == pytest.approx(loss, abs=0.01)
    assert monitor.lost == pytest.approx(20_000 * loss, rel=0.05)


def test_nothing_is_said_before_there_is_something_to_judge() -> None:
    monitor = listen(stream(MIN_EXPECTED - 1))
    assert monitor.loss(0.4) is None
    monitor.take(MIN_EXPECTED - 1, 0.4)
    assert monitor.loss(0.4) == 0.0


def test_a_loss_of_long_ago_is_forgotten() -> None:
    frames = [f for f in stream(400) if not 1.0 <= f[1] < 2.0]
    assert listen([f for f in frames if f[1] < 3.0]).loss(3.0) == pytest.approx(1 / 3, abs=0.02)
    assert listen(frames).loss(8.0) == 0.0


def test_frames_that_overtake_each_other_are_late_and_not_lost() -> None:
    rng = random.Random(2)
    sent = [(n * PERIOD_S + rng.uniform(0.0, 0.2), n) for n in range(2000)]
    monitor = SequenceMonitor()
    numbers = [monitor.take(n % 256, t) for t, n in sorted(sent)]
    assert numbers == [n for _, n in sorted(sent)]
    assert (monitor.lost, monitor.duplicates) == (0, 0)
    assert monitor.late > 1000
    assert monitor.loss(40.0) == pytest.approx(0.0, abs=0.05)


def test_a_frame_that_comes_twice_is_reported_and_not_counted() -> None:
    monitor = SequenceMonitor()
    for sequence, now_s in stream(600):
        assert monitor.take(sequence, now_s) == monitor.take(sequence, now_s)
    assert (monitor.received, monitor.duplicates, monitor.lost) == (600, 600, 0)


@pytest.mark.parametrize("missed", [127, 128, 200, 254])
def test_after_a_silence_the_count_went_ahead_and_not_back(missed: int) -> None:
    monitor = listen(stream(10))
    assert monitor.take((10 + missed) % 256, 10.0) == 10 + missed
    assert monitor.lost == missed


def test_after_a_silence_the_same_number_is_a_new_frame() -> None:
    monitor = listen(stream(10))
    assert monitor.take(9, 10.0) == 9 + 256


def test_a_sender_that_starts_again_loses_nothing_by_it() -> None:
    monitor = listen(stream(100))
    monitor.restart()
    assert monitor.loss(2.0) is None
    assert monitor.take(3, 2.0) == 3
    assert monitor.lost == 0
