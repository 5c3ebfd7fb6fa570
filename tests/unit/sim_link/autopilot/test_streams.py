"""Stream timing on the physics clock."""

from __future__ import annotations

from itertools import pairwise

from companion.mav.dialect import mavlink
from sim_link.autopilot.streams import StreamTable

LOCAL_POSITION = mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED


def test_a_rate_that_does_not_fit_the_clock_is_kept_on_average() -> None:
    table = StreamTable()
    times = [step * 0.02 for step in range(1000) if LOCAL_POSITION in table.take_due(step * 0.02)]
    assert 599 <= len(times) <= 601
    gaps = {round(later - earlier, 3) for earlier, later in pairwise(times)}
    assert gaps == {0.02, 0.04}


def test_time_that_jumps_does_not_make_a_burst() -> None:
    table = StreamTable()
    table.take_due(0.0)
    seen = [table.take_due(100.0 + step * 0.02).count(LOCAL_POSITION) for step in range(50)]
    assert 29 <= sum(seen) <= 32
