from __future__ import annotations

import math

import pytest

from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.ardupilot import firmware_profile as ardupilot_firmware
from sim_link.autopilot.protocols.addressing import Channel, Outgoing, Partner, StatusTexts
from sim_link.autopilot.protocols.command_protocol import Command, CommandResult
from sim_link.autopilot.protocols.message_streams import (
    MAX_PEERS,
    MessageRequests,
    RequestProfile,
    StreamProfile,
)
from sim_link.autopilot.px4 import firmware_profile as px4_firmware
from tests.unit.sim_link.autopilot.protocols.wire import (
    COMPANION,
    COMPANION_CHANNEL,
    STATION,
    STATION_CHANNEL,
    of_type,
    received,
)

PX4_REQUESTS = px4_firmware.FIRMWARE.requests
ARDUPILOT_REQUESTS = ardupilot_firmware.FIRMWARE.requests

NAN = math.nan
ATTITUDE, VERSION, HOME, INTERVAL = 30, 148, 242, 244
REQUEST, SET, GET = 512, 511, 510
STREAMS = StreamProfile({0: 1.0, ATTITUDE: 10.0, VERSION: 0.0}, 0.004, groups={10: (ATTITUDE,)})
Interval = mavlink.MAVLink_message_interval_message
Text = mavlink.MAVLink_statustext_message


def build(number: int) -> Message | None:
    """A vehicle that has an attitude and a version but no home yet."""
    if number == VERSION:
        return mavlink.MAVLink_autopilot_version_message(
            1, 2, 3, 4, 5, bytes(8), bytes(8), bytes(8), 6, 7, 8
        )
    if number == ATTITUDE:
        return mavlink.MAVLink_attitude_message(1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    return None


def requests(rules: RequestProfile = PX4_REQUESTS) -> MessageRequests:
    made = MessageRequests(STREAMS, rules, build, StatusTexts())
    made.open(STATION_CHANNEL, 0.0)
    made.open(COMPANION_CHANNEL, 0.0)
    return made


def command(number: int, first: float = NAN, second: float = NAN) -> Command:
    return Command(number, (first, second, NAN, NAN, NAN, NAN, NAN), STATION)


def obey(
    made: MessageRequests, number: int, first: float = NAN, second: float = NAN
) -> tuple[int, list[Outgoing]]:
    answer = made.handle_command(command(number, first, second), 0.0)
    assert answer is not None
    return answer


def due(made: MessageRequests, until_s: float) -> dict[tuple[Partner, int], int]:
    counts = {(partner, number): 0 for partner in (STATION, COMPANION) for number in (0, ATTITUDE)}
    for step in range(round(until_s / 0.01)):
        for channel, number in made.take_due(0.01 * step):
            counts[STATION if channel == STATION_CHANNEL else COMPANION, number] += 1
    return counts


def test_a_message_that_is_asked_for_is_sent_to_the_asker() -> None:
    result, (outgoing,) = obey(requests(), REQUEST, VERSION)
    assert result == CommandResult.ACCEPTED
    assert outgoing.to == STATION_CHANNEL
    assert of_type([outgoing], mavlink.MAVLink_autopilot_version_message)


@pytest.mark.parametrize(("number", "first"), [(520, 1.0), (520, NAN)])
def test_the_older_form_is_understood(number: int, first: float) -> None:
    result, outgoing = obey(requests(), number, first)
    assert result == CommandResult.ACCEPTED
    assert len(outgoing) == 1


@pytest.mark.parametrize(
    ("rules", "result"),
    [(PX4_REQUESTS, CommandResult.DENIED), (ARDUPILOT_REQUESTS, CommandResult.FAILED)],
)
@pytest.mark.parametrize("number", [9999, HOME])
def test_what_is_unknown_or_has_no_data_is_refused(
    rules: RequestProfile, result: int, number: int
) -> None:
    assert obey(requests(rules), REQUEST, number) == (result, [])


def test_home_by_its_own_command_is_refused_while_there_is_none() -> None:
    assert obey(requests(), 410) == (CommandResult.DENIED, [])


@pytest.mark.parametrize("first", [NAN, 0.5, -1.0, math.inf, 2.0**24])
@pytest.mark.parametrize("number", [REQUEST, GET])
def test_what_is_no_message_id_is_denied(number: int, first: float) -> None:
    assert obey(requests(), number, first) == (CommandResult.DENIED, [])


@pytest.mark.parametrize(("number", "params"), [(GET, (ATTITUDE,)), (REQUEST, (INTERVAL, 30.0))])
def test_an_interval_is_reported_in_either_form(number: int, params: tuple[float, ...]) -> None:
    result, outgoing = obey(requests(), number, *params)
    (interval,) = of_type(outgoing, Interval)
    assert result == CommandResult.ACCEPTED
    assert (interval.message_id, interval.interval_us) == (ATTITUDE, 100_000)


@pytest.mark.parametrize(
    ("rules", "expected"),
    [(PX4_REQUESTS, CommandResult.ACCEPTED), (ARDUPILOT_REQUESTS, CommandResult.FAILED)],
)
def test_the_interval_of_what_is_unknown_is_zero(rules: RequestProfile, expected: int) -> None:
    result, outgoing = obey(requests(rules), GET, 9999)
    (interval,) = of_type(outgoing, Interval)
    assert (result, interval.interval_us) == (expected, 0)


def test_a_rate_is_changed_on_the_channel_that_asked_and_on_no_other() -> None:
    made = requests()
    assert obey(made, SET, ATTITUDE, 50_000.0) == (CommandResult.ACCEPTED, [])
    counts = due(made, 2.0)
    assert (counts[STATION, ATTITUDE], counts[COMPANION, ATTITUDE]) == (40, 20)


@pytest.mark.parametrize(
    ("rules", "result", "texts"),
    [(PX4_REQUESTS, CommandResult.FAILED, 0), (ARDUPILOT_REQUESTS, CommandResult.DENIED, 1)],
)
@pytest.mark.parametrize("interval_us", [50_000.0, 0.0, -1.0, -2.0])
@pytest.mark.parametrize("number", [9999, 0])
def test_a_stream_that_cannot_be_set_is_refused_as_the_autopilot_does(
    rules: RequestProfile, result: int, texts: int, number: int, interval_us: float
) -> None:
    got, outgoing = obey(requests(rules), SET, number, interval_us)
    assert (got, len(of_type(outgoing, Text))) == (result, texts)


@pytest.mark.parametrize("interval_us", [NAN, math.inf, -2.0, 3601e6])
def test_an_interval_that_makes_no_sense_is_denied(interval_us: float) -> None:
    assert obey(requests(), SET, ATTITUDE, interval_us)[0] == CommandResult.DENIED


def test_a_data_stream_request_is_obeyed_on_its_channel() -> None:
    made = requests()
    asked = mavlink.MAVLink_request_data_stream_message(1, 1, 10, 4, 1)
    made.set_data_stream(received(asked, COMPANION), COMPANION, 0.0)
    counts = due(made, 2.0)
    assert (counts[STATION, ATTITUDE], counts[COMPANION, ATTITUDE]) == (20, 8)


def test_a_channel_that_is_gone_gets_nothing() -> None:
    made = requests()
    made.forget(STATION_CHANNEL)
    assert due(made, 2.0)[STATION, ATTITUDE] == 0
    made.forget(COMPANION_CHANNEL)
    assert made.take_due(2.0) == []


def test_opening_a_channel_again_does_not_reset_it() -> None:
    made = requests()
    obey(made, SET, ATTITUDE, -1.0)
    made.open(STATION_CHANNEL, 1.0)
    assert due(made, 2.0)[STATION, ATTITUDE] == 0


def test_other_commands_are_for_the_vehicle() -> None:
    assert requests().handle_command(command(400, 1.0), 0.0) is None


def test_a_stranger_with_many_ports_gets_a_bounded_number_of_streams() -> None:
    made = requests()
    for port in range(1000):
        made.open(Channel(0, ("127.0.0.1", 20_000 + port)), 0.0)
        made.open(STATION_CHANNEL, 0.0)
    served = {channel for channel, _ in made.take_due(0.0)}
    assert STATION_CHANNEL in served
    assert len(served) == MAX_PEERS
