from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.link.conversion.sender_clock import CONFIRM_S, WRAP_S, ClockStep, Timebase


def test_the_first_stamp_is_read_as_its_arrival() -> None:
    reading = Timebase().read(500.0, 10.0)
    assert reading.time_s == 10.0
    assert reading.step is ClockStep.NONE


def test_the_smallest_delay_seen_defines_the_offset() -> None:
    timebase, rng = Timebase(), random.Random(1)
    for step in range(1000):
        remote_s = 0.1 * step
        arrival_s = 40.0 + remote_s + 0.005 + rng.expovariate(1 / 0.05)
        reading = timebase.read(remote_s, arrival_s)
    # Only the constant part of the delay cannot be separated from the offset.
    assert reading.time_s - (40.0 + remote_s) == pytest.approx(0.005, abs=0.01)


def test_a_delayed_stamp_is_dated_back_to_its_measurement() -> None:
    timebase = Timebase()
    timebase.read(0.0, 10.0)
    assert timebase.read(1.0, 11.4).time_s == pytest.approx(11.0, abs=1e-3)


def restart(timebase: Timebase, boot_s: float, now_s: float) -> float:
    """Give stamps of a new clock at 20 Hz; return the time until the restart was detected."""
    for step in range(20):
        passed_s = 0.05 * step
        if timebase.read(boot_s + passed_s, now_s + passed_s).step is ClockStep.RESTART:
            return passed_s
    raise AssertionError("no restart was detected")


def test_a_reboot_is_reported_once_it_goes_on_and_starts_a_new_offset() -> None:
    timebase = Timebase()
    timebase.read(1000.0, 10.0)
    assert restart(timebase, 0.5, 20.0) == pytest.approx(CONFIRM_S, abs=0.051)
    following = timebase.read(2.5, 22.0)
    assert following.step is ClockStep.NONE
    assert following.time_s == pytest.approx(22.0)


def test_until_it_is_reported_the_stamps_of_a_new_clock_are_old_ones() -> None:
    timebase = Timebase()
    timebase.read(1000.0, 10.0)
    assert timebase.read(0.5, 20.0).time_s == pytest.approx(10.0 - 999.5)


@pytest.mark.parametrize("late_s", [1.5, 5.0, 100.0])
def test_frames_that_come_late_by_another_way_are_no_reboot(late_s: float) -> None:
    """Two ways, one of them slow: every frame comes twice."""
    timebase = Timebase()
    for step in range(4000):
        now_s = 200.0 + 0.05 * step
        assert timebase.read(now_s, now_s).step is ClockStep.NONE
        assert timebase.read(now_s - late_s, now_s).step is ClockStep.NONE


def test_a_burst_of_late_frames_is_no_reboot() -> None:
    timebase = Timebase()
    timebase.read(100.0, 10.0)
    timebase.read(105.0, 15.0)
    readings = [timebase.read(101.0 + 0.05 * n, 15.0 + 0.001 * n) for n in range(60)]
    assert all(reading.step is ClockStep.NONE for reading in readings)


def test_two_stamps_are_not_enough_for_a_reboot_however_long_they_last() -> None:
    timebase = Timebase()
    timebase.read(100.0, 10.0)
    assert timebase.read(1.0, 11.0).step is ClockStep.NONE
    assert timebase.read(11.0, 21.0).step is ClockStep.NONE
    assert timebase.read(11.1, 21.1).step is ClockStep.RESTART


def test_stamps_that_go_back_without_any_order_are_no_reboot() -> None:
    timebase, rng = Timebase(), random.Random(3)
    timebase.read(1e6, 10.0)
    for step in range(200):
        assert timebase.read(rng.uniform(0.0, 1e5), 11.0 + 0.05 * step).step is ClockStep.NONE


def test_the_offset_after_a_reboot_is_the_best_of_the_first_stamps() -> None:
    timebase = Timebase()
    timebase.read(1000.0, 10.0)
    for stamp_s, now_s in ((0.0, 20.4), (0.2, 20.2), (0.4, 20.75)):
        reading = timebase.read(stamp_s, now_s)
    assert reading.step is ClockStep.RESTART
    assert reading.time_s == pytest.approx(20.4)


def test_a_late_frame_is_no_reboot() -> None:
    timebase = Timebase()
    timebase.read(100.0, 10.0)
    timebase.read(101.0, 11.0)
    late = timebase.read(100.2, 11.05)
    assert late.step is ClockStep.NONE
    assert late.time_s == pytest.approx(10.2, abs=1e-3)
    assert timebase.read(101.1, 11.1).step is ClockStep.NONE


def test_the_wrap_of_time_boot_ms_is_no_reboot() -> None:
    timebase = Timebase()
    timebase.read(WRAP_S - 0.5, 10.0)
    reading = timebase.read(0.5, 11.0)
    assert reading.step is ClockStep.NONE
    assert reading.time_s == pytest.approx(11.0, abs=1e-3)
    assert timebase.read(10.5, 21.0).time_s == pytest.approx(21.0, abs=1e-2)


def test_a_late_frame_from_before_the_wrap_is_still_from_before() -> None:
    timebase = Timebase()
    timebase.read(WRAP_S - 0.5, 10.0)
    timebase.read(0.5, 11.0)
    late = timebase.read(WRAP_S - 0.1, 11.1)
    assert late.step is ClockStep.NONE
    assert late.time_s == pytest.approx(10.4, abs=1e-2)
    assert timebase.read(1.5, 12.0).time_s == pytest.approx(12.0, abs=1e-2)


def test_a_reboot_after_a_wrap_is_still_a_reboot() -> None:
    timebase = Timebase()
    timebase.read(WRAP_S - 0.5, 10.0)
    timebase.read(0.5, 11.0)
    timebase.read(500.0, 510.5)
    assert restart(timebase, 3.0, 530.0) < 0.5
    assert timebase.read(5.0, 532.0).time_s == pytest.approx(532.0)


def test_reordering_about_the_wrap_is_neither_a_reboot_nor_time_lost() -> None:
    timebase, rng = Timebase(), random.Random(4)
    sent = [(n, WRAP_S - 5.0 + 0.05 * n) for n in range(200)]
    arrivals = sorted((0.05 * n + rng.uniform(0.0, 0.3), stamp_s) for n, stamp_s in sent)
    for now_s, stamp_s in arrivals:
        reading = timebase.read(stamp_s % WRAP_S, now_s)
        assert reading.step is ClockStep.NONE
        assert now_s - 0.32 <= reading.time_s <= now_s


def test_a_fall_from_unix_time_to_time_since_boot_is_a_reboot() -> None:
    timebase = Timebase()
    timebase.read(1.795e9, 10.0)
    assert restart(timebase, 0.5, 20.0) < 0.5
    assert timebase.read(2.5, 22.0).time_s == pytest.approx(22.0)


@pytest.mark.parametrize("ppm", [-100.0, 100.0])
def test_a_drifting_clock_is_followed_for_hours(ppm: float) -> None:
    timebase = Timebase()
    for second in range(4 * 3600):
        now_s = float(second)
        reading = timebase.read(now_s * (1.0 + ppm * 1e-6), now_s)
        assert now_s - reading.time_s < 0.001


@given(
    st.lists(
        st.tuples(st.floats(0.0, 5e6), st.floats(0.0, 100.0)),
        min_size=1,
        max_size=40,
    )
)
def test_no_stamp_is_ever_read_as_the_future(steps: list[tuple[float, float]]) -> None:
    timebase, now_s = Timebase(), 0.0
    for remote_s, waited_s in steps:
        now_s += waited_s
        assert timebase.read(remote_s, now_s).time_s <= now_s
