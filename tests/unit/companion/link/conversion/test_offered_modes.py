"""Modes that an ArduPilot offers, requested until the list is whole, and when it changes."""

from __future__ import annotations

from companion.domain import Autopilot
from companion.link.inbound import MAX_REQUESTS, OfferedModes
from companion.mav.dialect import mavlink

TARGET = (1, 1)


def listed(number: int, index: int, of: int) -> mavlink.MAVLink_available_modes_message:
    return mavlink.MAVLink_available_modes_message(of, index, 0, number, 0, b"NAME")


def shown(number: int) -> mavlink.MAVLink_heartbeat_message:
    return mavlink.MAVLink_heartbeat_message(2, 3, 0x59, number, 4, 3)


def asked(modes: OfferedModes, seconds: float, autopilot: Autopilot = Autopilot.ARDUPILOT) -> int:
    ticks = range(round(seconds / 0.05))
    return sum(modes.due(0.05 * tick, autopilot, TARGET) is not None for tick in ticks)


def test_only_an_ardupilot_is_asked_and_one_that_refuses_a_few_times() -> None:
    assert asked(OfferedModes(), 60.0, Autopilot.PX4) == 0
    assert asked(OfferedModes(), 60.0) == MAX_REQUESTS


def test_an_incomplete_list_is_asked_for_again_and_a_whole_one_is_not() -> None:
    modes = OfferedModes()
    modes.receive(listed(4, 1, 2))
    assert asked(modes, 0.1) == 1
    modes.receive(listed(30, 2, 2))
    assert asked(modes, 60.0) == 0


def test_the_answer_counts_once_another_mode_is_shown() -> None:
    modes = OfferedModes()
    modes.receive(shown(30))
    modes.receive(listed(30, 1, 1))
    modes.receive(shown(30))
    assert not modes.understands_offboard
    modes.receive(shown(5))
    modes.receive(shown(30))
    assert modes.understands_offboard


def test_a_mode_that_a_script_registers_later_is_found_when_the_list_changes() -> None:
    modes = OfferedModes()
    modes.receive(mavlink.MAVLink_available_modes_monitor_message(1))
    modes.receive(listed(4, 1, 1))
    modes.receive(mavlink.MAVLink_available_modes_monitor_message(1))
    assert asked(modes, 60.0) == 0
    modes.receive(mavlink.MAVLink_available_modes_monitor_message(2))
    assert asked(modes, 0.1) == 1
    for index, number in enumerate((4, 30), 1):
        modes.receive(listed(number, index, 2))
    modes.receive(shown(5))
    assert modes.understands_offboard


def test_the_number_itself_asks_for_a_list_that_was_answered_without_it() -> None:
    modes = OfferedModes()
    modes.receive(listed(4, 1, 1))
    assert asked(modes, 60.0) == 0
    modes.receive(shown(30))
    assert asked(modes, 60.0) == MAX_REQUESTS
