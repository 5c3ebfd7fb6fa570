from __future__ import annotations

import math
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_link.autopilot.protocols.message_streams import HEARTBEAT, StreamProfile, StreamTable

ATTITUDE, POSITION, VERSION, STATE = 30, 32, 148, 245
STEP_S = 0.004
RULES = StreamProfile(
    {HEARTBEAT: 1.0, ATTITUDE: 50.0, POSITION: 30.0, VERSION: 0.0, STATE: 0.0},
    min_interval_s=0.004,
    groups={6: (POSITION,), 10: (ATTITUDE, HEARTBEAT)},
)


def run(
    table: StreamTable, duration_s: float, step_s: float = STEP_S, start_s: float = 0.0
) -> dict[int, list[float]]:
    """Return the times at which each message was sent."""
    times: dict[int, list[float]] = {}
    for step in range(round(duration_s / step_s)):
        now_s = start_s + step * step_s
        for number in table.take_due(now_s):
            times.setdefault(number, []).append(now_s)
    return times


@pytest.mark.parametrize("step_s", [0.001, 0.004, 0.02])
@pytest.mark.parametrize("rate_hz", [0.5, 1.0, 3.0, 4.0, 7.0, 10.0, 29.97, 30.0, 49.0, 50.0])
def test_the_rate_over_a_minute_is_the_one_asked(rate_hz: float, step_s: float) -> None:
    table = StreamTable(StreamProfile({POSITION: rate_hz}, min_interval_s=0.004))
    assert len(run(table, 60.0, step_s)[POSITION]) == pytest.approx(60.0 * rate_hz, abs=1)


@settings(deadline=None)
@given(rate_hz=st.floats(0.1, 200.0), hours=st.integers(0, 1000))
def test_no_rounding_adds_up(rate_hz: float, hours: int) -> None:
    table = StreamTable(StreamProfile({POSITION: rate_hz}, min_interval_s=0.004), 3600.0 * hours)
    times = run(table, 5.0, start_s=3600.0 * hours)[POSITION]
    interval_s = 1.0 / rate_hz
    for number, time_s in enumerate(times):
        late_s = time_s - 3600.0 * hours - number * interval_s
        assert -2e-6 <= late_s <= STEP_S + 2e-6


def test_a_message_leaves_once_per_call_and_what_was_missed_is_skipped_in_step() -> None:
    table = StreamTable(RULES)
    table.take_due(0.0)
    assert sorted(table.take_due(10.005)) == [HEARTBEAT, ATTITUDE, POSITION]
    due_s = run(table, 1.0, start_s=10.008)[ATTITUDE]
    assert len(due_s) == 50
    assert all(later - earlier <= 0.0241 for earlier, later in pairwise(due_s))


def test_messages_without_a_rate_do_not_leave_by_themselves() -> None:
    assert set(run(StreamTable(RULES), 2.0)) == {HEARTBEAT, ATTITUDE, POSITION}


def test_a_changed_rate_begins_at_once() -> None:
    table = StreamTable(RULES)
    run(table, 1.0)
    assert table.set_interval_us(STATE, 200_000.0, 1.0)
    assert run(table, 1.0, start_s=1.0)[STATE] == pytest.approx([1.0, 1.2, 1.4, 1.6, 1.8])


def test_asking_again_for_the_same_rate_does_not_disturb_it() -> None:
    table = StreamTable(RULES)
    count = 0
    for step in range(250):
        table.set_interval_us(POSITION, 100_000.0, step * STEP_S)
        count += POSITION in table.take_due(step * STEP_S)
    assert count == 10


def test_minus_one_stops_and_zero_restores_the_default() -> None:
    table = StreamTable(RULES)
    assert table.set_interval_us(ATTITUDE, -1.0, 0.0)
    assert ATTITUDE not in run(table, 1.0)
    assert table.interval_us(ATTITUDE) == -1
    assert table.set_interval_us(ATTITUDE, 0.0, 1.0)
    assert len(run(table, 1.0, start_s=1.0)[ATTITUDE]) == 50
    assert table.set_interval_us(VERSION, 0.0, 2.0)
    assert table.interval_us(VERSION) == -1


def test_faster_than_possible_is_as_fast_as_possible_and_reported_so() -> None:
    table = StreamTable(RULES)
    table.set_interval_us(ATTITUDE, 10.0, 0.0)
    assert table.interval_us(ATTITUDE) == 4000
    assert len(run(table, 1.0)[ATTITUDE]) == 250


@pytest.mark.parametrize("interval_us", [-2.0, -0.5, math.nan, math.inf, 3601e6])
def test_an_interval_that_makes_no_sense_is_refused(interval_us: float) -> None:
    table = StreamTable(RULES)
    assert not table.set_interval_us(ATTITUDE, interval_us, 0.0)
    assert table.interval_us(ATTITUDE) == 20_000


def test_the_heartbeat_and_unknown_messages_cannot_be_changed() -> None:
    table = StreamTable(RULES)
    assert not table.set_interval_us(HEARTBEAT, 20_000.0, 0.0)
    assert not table.set_interval_us(9999, 20_000.0, 0.0)
    assert (table.interval_us(HEARTBEAT), table.interval_us(9999)) == (1_000_000, 0)


def test_a_group_changes_together_but_for_what_is_fixed() -> None:
    table = StreamTable(RULES)
    table.set_group(10, 5, is_on=True, now_s=0.0)
    assert table.interval_us(ATTITUDE) == 200_000
    assert table.interval_us(POSITION) == round(1e6 / 30)
    assert table.interval_us(HEARTBEAT) == 1_000_000


def test_group_zero_is_all_groups() -> None:
    table = StreamTable(RULES)
    table.set_group(0, 4, is_on=True, now_s=0.0)
    assert [table.interval_us(number) for number in (ATTITUDE, POSITION, STATE)] == [
        250_000,
        250_000,
        -1,
    ]


@pytest.mark.parametrize(("rate_hz", "is_on"), [(0, True), (10, False)])
def test_a_group_is_stopped_by_its_flag_or_a_rate_of_zero(rate_hz: int, is_on: bool) -> None:
    table = StreamTable(RULES)
    table.set_group(6, rate_hz, is_on=is_on, now_s=0.0)
    assert table.interval_us(POSITION) == -1


def test_an_unknown_group_changes_nothing() -> None:
    table = StreamTable(RULES)
    table.set_group(77, 10, is_on=True, now_s=0.0)
    assert table.interval_us(POSITION) == round(1e6 / 30)


def test_a_client_that_changes_rates_for_ever_does_not_fill_the_memory() -> None:
    table = StreamTable(RULES)
    for step in range(20_000):
        now_s = step * STEP_S
        table.set_interval_us(ATTITUDE, 3600e6 if step % 2 else 1e6, now_s)
        table.take_due(now_s)
    assert len(table._streams) <= len(RULES.default_rates_hz)
    assert len(run(table, 3.0, start_s=80.0)[POSITION]) == 90
