"""The command protocol, between a ground station and a vehicle that does as the test says."""

from __future__ import annotations

import math

import pytest

from companion.mav.dialect import MAVLink_command_cancel_message, Message, mavlink
from sim_link.autopilot.protocols.addressing import Outgoing, Partner
from sim_link.autopilot.protocols.command_protocol import (
    REPEAT_WINDOW_S,
    Cancel,
    Command,
    CommandForms,
    CommandResult,
    Commands,
    command_from,
)
from tests.unit.sim_link.autopilot.protocols.wire import (
    COMPANION,
    COMPANION_CHANNEL,
    STATION,
    STATION_CHANNEL,
    of_type,
    received,
)

NAN = math.nan
ARM, TAKEOFF, REPOSITION, REQUEST, CALIBRATE = 400, 22, 192, 512, 241
Ack = mavlink.MAVLink_command_ack_message


def long(number: int, *params: float, confirmation: int = 0) -> Message:
    """COMMAND_LONG, what is not given NaN, as MAVSDK sends it."""
    padded = [*params, *[NAN] * (7 - len(params))]
    return mavlink.MAVLink_command_long_message(1, 1, number, confirmation, *padded)


def int_(number: int, frame: int = 6, x: int = 0, y: int = 0, z: float = NAN) -> Message:
    return mavlink.MAVLink_command_int_message(
        1, 1, frame, number, 0, 0, NAN, NAN, NAN, NAN, x, y, z
    )


def command_of(message: Message, partner: Partner = STATION) -> Command:
    command = command_from(received(message, partner), partner)
    assert command is not None
    return command


class Vehicle:
    """Vehicle that takes commands and answers each with a given result."""

    def __init__(self, forms: CommandForms | None = None) -> None:
        self.commands = Commands(forms or CommandForms())
        self.obeyed: list[Command | Cancel] = []
        self.now_s = 0.0

    def send(
        self,
        message: Message,
        result: int = CommandResult.ACCEPTED,
        partner: Partner = STATION,
    ) -> list[Outgoing]:
        todo, answers = self.commands.receive(received(message, partner), partner, self.now_s)
        if todo is None:
            return answers
        self.obeyed.append(todo)
        if isinstance(todo, Cancel):
            return self.commands.finish(todo.number, CommandResult.CANCELLED, self.now_s)
        return [*answers, self.commands.answer(todo, result, self.now_s)]


def results(outgoing: list[Outgoing]) -> list[int]:
    return [ack.result for ack in of_type(outgoing, Ack)]


# What a command is


def test_command_long_keeps_its_nans_and_has_no_frame() -> None:
    command = command_of(long(TAKEOFF, 1.0))
    assert (command.number, command.frame, command.params[0]) == (TAKEOFF, None, 1.0)
    assert all(math.isnan(param) for param in command.params[1:])


def test_command_int_keeps_its_frame_and_its_integers_exactly() -> None:
    command = command_of(int_(REPOSITION, 6, 473_977_421, -1_799_999_999, 12.5))
    assert (command.frame, command.params[6]) == (6, 12.5)
    assert command.params[4:6] == (473_977_421.0, -1_799_999_999.0)


def test_a_place_is_read_from_either_form() -> None:
    by_int = command_of(int_(REPOSITION, 6, 473_977_421, 85_000_000))
    by_long = command_of(long(REPOSITION, NAN, NAN, NAN, NAN, 47.5, 8.5))
    assert by_int.position_e7 is not None
    assert by_int.position_e7[0] == 473_977_421
    assert by_long.position_e7 == (475_000_000, 85_000_000)


def test_a_place_left_open_is_none_in_either_form() -> None:
    assert command_of(int_(REPOSITION, 6, 2**31 - 1, 2**31 - 1)).position_e7 is None
    assert command_of(long(REPOSITION)).position_e7 is None


@pytest.mark.parametrize(
    ("value", "whole"), [(76.0, 76), (NAN, 5), (0.5, None), (math.inf, None), (-1.0, -1)]
)
def test_a_whole_number_may_be_left_open(value: float, whole: int | None) -> None:
    assert command_of(long(REQUEST, value)).whole(1, default=5) == whole


def test_set_mode_is_do_set_mode_in_each_autopilots_form() -> None:
    message = received(mavlink.MAVLink_set_mode_message(1, 1, 0x0304_0000))
    px4 = command_from(message, STATION)
    ardupilot = command_from(message, STATION, splits_custom_mode=False)
    assert px4 is not None
    assert ardupilot is not None
    assert px4.params[:3] == (1.0, 4.0, 3.0)
    assert ardupilot.params[1] == 0x0304_0000
    assert px4.number == ardupilot.number == mavlink.MAV_CMD_DO_SET_MODE


def test_other_messages_are_no_commands() -> None:
    vehicle = Vehicle()
    assert vehicle.send(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)) == []
    assert vehicle.obeyed == []


# The ACK


def test_every_command_is_answered_to_its_sender_where_it_came_from() -> None:
    (outgoing,) = Vehicle().send(long(ARM, 1.0), CommandResult.FAILED, COMPANION)
    assert outgoing.to == COMPANION_CHANNEL
    (ack,) = of_type([outgoing], Ack)
    assert (ack.command, ack.result) == (ARM, CommandResult.FAILED)
    assert (ack.target_system, ack.target_component) == (1, 191)


def test_the_result_numbers_beyond_the_dialects_enum_can_be_sent() -> None:
    result = CommandResult.UNSUPPORTED_MAV_FRAME
    assert results(Vehicle().send(int_(REPOSITION), result)) == [9]


def test_a_command_that_has_only_the_other_form_is_unsupported() -> None:
    vehicle = Vehicle(CommandForms(frozenset({REPOSITION})))
    assert results(vehicle.send(long(REPOSITION))) == [CommandResult.UNSUPPORTED]
    assert vehicle.obeyed == []


# Repetition


def test_a_repeated_command_gets_its_ack_again_and_is_obeyed_once() -> None:
    vehicle = Vehicle()
    answers = [vehicle.send(long(ARM, 1.0, confirmation=n)) for n in range(3)]
    assert [results(each) for each in answers] == [[CommandResult.ACCEPTED]] * 3
    assert len(vehicle.obeyed) == 1


def test_a_refused_command_is_tried_again() -> None:
    vehicle = Vehicle()
    vehicle.send(long(ARM, 1.0), CommandResult.TEMPORARILY_REJECTED)
    assert results(vehicle.send(long(ARM, 1.0, confirmation=1))) == [CommandResult.ACCEPTED]
    assert len(vehicle.obeyed) == 2


@pytest.mark.parametrize(
    ("again", "partner", "pause_s"),
    [
        (long(ARM, 1.0, confirmation=0), STATION, 0.5),
        (long(ARM, 0.0, confirmation=1), STATION, 0.5),
        (long(TAKEOFF, 1.0, confirmation=1), STATION, 0.5),
        (long(ARM, 1.0, confirmation=1), COMPANION, 0.5),
        (long(ARM, 1.0, confirmation=1), STATION, REPEAT_WINDOW_S + 0.1),
    ],
)
def test_what_is_not_a_repetition_is_obeyed(
    again: Message, partner: Partner, pause_s: float
) -> None:
    vehicle = Vehicle()
    vehicle.send(long(ARM, 1.0))
    vehicle.now_s += pause_s
    vehicle.send(again, partner=partner)
    assert len(vehicle.obeyed) == 2


def test_who_repeats_a_request_for_a_message_gets_the_message_again() -> None:
    vehicle = Vehicle()
    for confirmation in range(3):
        vehicle.send(long(REQUEST, 148.0, confirmation=confirmation))
    assert len(vehicle.obeyed) == 3


def test_command_int_has_no_confirmation_and_is_obeyed_each_time() -> None:
    vehicle = Vehicle()
    for _ in range(2):
        vehicle.send(int_(REPOSITION))
    assert len(vehicle.obeyed) == 2


def test_what_is_remembered_is_bounded() -> None:
    vehicle = Vehicle()
    for system in range(2, 202):
        vehicle.send(long(ARM, 1.0), partner=Partner(STATION_CHANNEL, system, 1))
    vehicle.send(long(ARM, 1.0, confirmation=1), partner=Partner(STATION_CHANNEL, 2, 1))
    assert len(vehicle.obeyed) == 201


# Commands that take time


@pytest.fixture
def calibrating() -> Vehicle:
    vehicle = Vehicle()
    assert results(vehicle.send(long(CALIBRATE, 1.0), CommandResult.IN_PROGRESS)) == [5]
    return vehicle


def test_progress_is_unknown_until_it_is_reported(calibrating: Vehicle) -> None:
    (ack,) = of_type(Vehicle().send(long(CALIBRATE, 1.0), CommandResult.IN_PROGRESS), Ack)
    assert ack.progress == 255
    (report,) = of_type(calibrating.commands.report(CALIBRATE, 40, 1.0), Ack)
    assert (report.result, report.progress) == (CommandResult.IN_PROGRESS, 40)


def test_it_ends_with_a_last_result_for_its_sender(calibrating: Vehicle) -> None:
    (outgoing,) = calibrating.commands.finish(CALIBRATE, CommandResult.ACCEPTED, 9.0)
    (ack,) = of_type([outgoing], Ack)
    assert (ack.result, ack.progress, outgoing.to) == (0, 0, STATION_CHANNEL)
    assert not calibrating.commands.is_running(CALIBRATE)
    assert calibrating.commands.finish(CALIBRATE, CommandResult.ACCEPTED, 9.0) == []


@pytest.mark.parametrize("partner", [STATION, COMPANION])
def test_the_same_command_meanwhile_is_temporarily_rejected(
    calibrating: Vehicle, partner: Partner
) -> None:
    answer = calibrating.send(long(CALIBRATE, 1.0), partner=partner)
    assert results(answer) == [CommandResult.TEMPORARILY_REJECTED]
    assert len(calibrating.obeyed) == 1


def test_a_repetition_meanwhile_is_reported_the_progress(calibrating: Vehicle) -> None:
    calibrating.commands.report(CALIBRATE, 40, 0.5)
    (ack,) = of_type(calibrating.send(long(CALIBRATE, 1.0, confirmation=1)), Ack)
    assert (ack.result, ack.progress) == (CommandResult.IN_PROGRESS, 40)


def test_another_command_meanwhile_is_obeyed(calibrating: Vehicle) -> None:
    assert results(calibrating.send(long(ARM, 1.0))) == [CommandResult.ACCEPTED]


def test_a_cancelled_command_ends_with_cancelled_to_its_sender(calibrating: Vehicle) -> None:
    (outgoing,) = calibrating.send(
        MAVLink_command_cancel_message(1, 1, CALIBRATE), partner=COMPANION
    )
    assert results([outgoing]) == [CommandResult.CANCELLED]
    assert outgoing.to == STATION_CHANNEL


def test_cancelling_what_is_not_under_way_is_ignored() -> None:
    vehicle = Vehicle()
    assert vehicle.send(MAVLink_command_cancel_message(1, 1, CALIBRATE)) == []
    assert vehicle.obeyed == []


def test_nothing_is_reported_of_what_is_not_under_way() -> None:
    assert Vehicle().commands.report(CALIBRATE, 10, 0.0) == []


def test_who_had_it_done_before_is_reported_that_another_has_it_under_way() -> None:
    vehicle = Vehicle()
    vehicle.send(long(CALIBRATE, 1.0), partner=COMPANION)
    vehicle.send(long(CALIBRATE, 1.0), CommandResult.IN_PROGRESS, STATION)
    answer = vehicle.send(long(CALIBRATE, 1.0, confirmation=1), partner=COMPANION)
    assert results(answer) == [CommandResult.TEMPORARILY_REJECTED]
