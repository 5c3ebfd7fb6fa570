from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.mav.timebase import WRAP_S, Timebase


def test_the_first_stamp_is_read_as_its_arrival() -> None:
    reading = Timebase().read(500.0, 10.0)
    assert reading.time_s == 10.0
    assert not reading.is_reboot


def test_the_smallest_delay_seen_defines_the_offset() -> None:
    timebase, rng = Timebase(), random.Random(1)
    for step in range(1000):
        remote_s = 0.1 * step
        arrival_s = 40.0 + remote_s + 0.005 + rng.expovariate(1 / 0.05)
        reading = timebase.read(remote_s, arrival_s)
    # Only the constant part of the delay cannot be told from the offset.
    assert reading.time_s - (40.0 + remote_s) == pytest.approx(0.005, abs=0.01)


def test_a_delayed_stamp_is_dated_back_to_its_measurement() -> None:
    timebase = Timebase()
    timebase.read(0.0, 10.0)
    assert timebase.read(1.0, 11.4).time_s == pytest.approx(11.0, abs=1e-3)


def test_a_reboot_is_told_and_starts_a_new_offset() -> None:
    timebase = Timebase()
    timebase.read(1000.0, 10.0)
    reading = timebase.read(0.5, 20.0)
    assert reading.is_reboot
    assert reading.time_s == 20.0
    following = timebase.read(1.5, 21.0)
    assert not following.is_reboot
    assert following.time_s == 21.0


def test_a_late_frame_is_no_reboot() -> None:
    timebase = Timebase()
    timebase.read(100.0, 10.0)
    timebase.read(101.0, 11.0)
    late = timebase.read(100.2, 11.05)
    assert not late.is_reboot
    assert late.time_s == pytest.approx(10.2, abs=1e-3)
    assert not timebase.read(101.1, 11.1).is_reboot


def test_the_wrap_of_time_boot_ms_is_no_reboot() -> None:
    timebase = Timebase()
    timebase.read(WRAP_S - 0.5, 10.0)
    reading = timebase.read(0.5, 11.0)
    assert not reading.is_reboot
    assert reading.time_s == pytest.approx(11.0, abs=1e-3)
    assert timebase.read(10.5, 21.0).time_s == pytest.approx(21.0, abs=1e-2)


def test_a_late_frame_from_before_the_wrap_is_still_from_before() -> None:
    timebase = Timebase()
    timebase.read(WRAP_S - 0.5, 10.0)
    timebase.read(0.5, 11.0)
    late = timebase.read(WRAP_S - 0.1, 11.1)
    assert not late.is_reboot
    assert late.time_s == pytest.approx(10.4, abs=1e-2)
    assert timebase.read(1.5, 12.0).time_s == pytest.approx(12.0, abs=1e-2)


def test_a_reboot_after_a_wrap_is_still_a_reboot() -> None:
    timebase = Timebase()
    timebase.read(WRAP_S - 0.5, 10.0)
    timebase.read(500.0, 510.5)
    reading = timebase.read(3.0, 530.0)
    assert reading.is_reboot
    assert reading.time_s == 530.0


def test_a_fall_from_unix_time_to_time_since_boot_is_a_reboot() -> None:
    timebase = Timebase()
    timebase.read(1.795e9, 10.0)
    reading = timebase.read(0.5, 20.0)
    assert reading.is_reboot
    assert reading.time_s == 20.0


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
