from __future__ import annotations

from collections.abc import Callable

import pytest

from companion.link.autopilot_queries import StreamFreshness
from companion.mav.dialect import Message, mavlink
from tests.unit.companion.link.wire import OFFBOARD, Wire, heartbeat, home_position, local_position

POSITION = mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED


def attitude(boot_ms: int) -> Message:
    return mavlink.MAVLink_attitude_message(boot_ms, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def test_the_age_of_a_stream_is_that_of_its_last_progress() -> None:
    freshness = StreamFreshness()
    assert freshness.age_s(POSITION, 5.0) is None
    assert freshness.receive(local_position(1000), 5.0)
    assert not freshness.receive(local_position(1000), 5.3)
    assert freshness.age_s(POSITION, 5.4) == pytest.approx(0.4)
    assert freshness.receive(local_position(1050), 5.5)
    assert freshness.age_s(POSITION, 5.5) == 0.0


@pytest.mark.parametrize("message", [heartbeat(), local_position(0)])
def test_without_a_stamp_every_arrival_is_progress(message: Message) -> None:
    freshness = StreamFreshness()
    assert freshness.receive(message, 1.0)
    assert freshness.receive(message, 2.0)


def test_home_is_stamped_when_it_is_set_and_comes_again_with_the_same_stamp() -> None:
    freshness = StreamFreshness()
    for second in range(40):
        freshness.receive(home_position(time_usec=7_000_000), 2.0 * second)
    assert freshness.stale(80.0) == ()
    assert freshness.stale(94.0) == ("home",)


def test_the_mean_gap_follows_the_rate() -> None:
    freshness = StreamFreshness()
    for step in range(100):
        freshness.receive(local_position(1 + step), 0.05 * step)
    assert freshness.stream(POSITION).gap_s == pytest.approx(0.05)
    for step in range(100):
        freshness.receive(local_position(200 + step), 5.0 + 0.5 * step)
    assert freshness.stream(POSITION).gap_s == pytest.approx(0.5, rel=0.01)


def test_what_stopped_is_stale_by_name_and_what_never_came_is_not() -> None:
    freshness = StreamFreshness()
    freshness.receive(local_position(1), 1.0)
    freshness.receive(attitude(1), 1.0)
    assert freshness.stale(1.5) == ()
    assert freshness.stale(1.51) == ("position",)
    assert freshness.stale(2.01) == ("position", "attitude")
    freshness.restart()
    assert freshness.stale(9.0) == ()


# The endpoint

SPOKEN: dict[str, Callable[[float], Message]] = {
    "position": lambda now_s: local_position(
        round(1e3 * now_s) + 1, 0.0, 0.0, -20.0, 0.0, 0.0, 0.0
    ),
    "attitude": lambda now_s: attitude(round(1e3 * now_s) + 1),
    "heartbeat": lambda _: heartbeat(custom_mode=OFFBOARD, is_armed=True, status=4),
    "landed state": lambda _: mavlink.MAVLink_extended_sys_state_message(0, 2),
    "status": lambda _: mavlink.MAVLink_sys_status_message(*[0] * 13),
    "home": lambda _: home_position(),
}


def speak(wire: Wire, seconds: float, muted: str = "") -> None:
    for _ in range(round(seconds / 0.05)):
        for name, make in SPOKEN.items():
            if name != muted:
                wire.say(make(wire.now_s))
        wire.wait(0.05)


@pytest.mark.parametrize("muted", list(SPOKEN))
def test_a_stream_that_stops_while_the_link_is_alive_is_reported_once_and_asked_for(
    muted: str,
) -> None:
    wire = Wire().ready(OFFBOARD)
    speak(wire, 3.0)
    wire.journal.texts.clear()
    speak(wire, 40.0, muted)
    said = [text for text in wire.journal.texts if "any more: requesting again" in text]
    assert said == [f"no {muted} received any more: requesting again"]


def test_a_lost_link_is_not_announced_stream_by_stream() -> None:
    wire = Wire().ready(OFFBOARD)
    speak(wire, 3.0)
    wire.wait(30.0)
    assert not any("any more: requesting again" in text for text in wire.journal.texts)


def test_a_stream_that_comes_and_goes_does_not_fill_the_log() -> None:
    wire = Wire().ready(OFFBOARD)
    for _ in range(30):
        speak(wire, 0.2)
        speak(wire, 0.8, "position")
    said = [text for text in wire.journal.texts if "any more: requesting again" in text]
    assert 1 <= len(said) <= 7
