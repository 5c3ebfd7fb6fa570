"""The parameter protocol of both autopilots, message by message."""

from __future__ import annotations

import math
import struct

import pytest

from companion.mav.dialect import Message, mavlink
from companion.mav.payloads import ParamType, raw_of
from sim_link.autopilot.ardupilot import firmware_profile as ardupilot_firmware
from sim_link.autopilot.protocols.addressing import Channel, Outgoing, Partner, StatusTexts
from sim_link.autopilot.protocols.parameter_protocol import (
    HASH_CHECK,
    MAX_LISTS,
    NO_INDEX,
    ParameterProfile,
    Parameters,
    ParameterStore,
    ParamSpec,
)
from sim_link.autopilot.px4 import firmware_profile as px4_firmware
from tests.unit.sim_link.autopilot.protocols.wire import (
    COMPANION,
    COMPANION_CHANNEL,
    STATION,
    STATION_CHANNEL,
    of_type,
    received,
    sent,
)

PX4_RULES = px4_firmware.FIRMWARE.parameters
ARDUPILOT_RULES = ardupilot_firmware.FIRMWARE.parameters

Value = mavlink.MAVLink_param_value_message
Text = mavlink.MAVLink_statustext_message
INT32, REAL32, INT8 = ParamType.INT32, ParamType.REAL32, ParamType.INT8
SPECS = (
    ParamSpec("SIXTEEN_LETTERS_", INT32, -7),
    ParamSpec("ALTITUDE", REAL32, 2.5, 0.0, 80.0, "m"),
    ParamSpec("ACTION", INT32, 2, 0, 5),
    ParamSpec("FLOWN", INT32, 0, is_read_only=True),
)


def px4(specs: tuple[ParamSpec, ...] = SPECS) -> Parameters:
    return Parameters(ParameterStore(specs), PX4_RULES, StatusTexts())


def ardupilot(specs: tuple[ParamSpec, ...] = SPECS) -> Parameters:
    return Parameters(ParameterStore(specs), ARDUPILOT_RULES, StatusTexts())


def parameters_of(rules: ParameterProfile) -> Parameters:
    return Parameters(ParameterStore(SPECS), rules, StatusTexts())


def ask(parameters: Parameters, message: Message) -> list[Outgoing]:
    return parameters.handle(received(message), STATION, 0.0)


def read(name: str = "", index: int = -1) -> Message:
    return mavlink.MAVLink_param_request_read_message(1, 1, name.encode(), index)


def setting(name: str, raw: bytes, kind: int) -> Message:
    """A PARAM_SET with exactly these four bytes."""
    value = struct.unpack("<f", raw)[0]
    return mavlink.MAVLink_param_set_message(1, 1, name.encode(), value, kind)


def set_real(name: str, value: float, kind: int = REAL32) -> Message:
    return setting(name, struct.pack("<f", value), kind)


def set_whole(name: str, value: int, kind: int = INT32) -> Message:
    return setting(name, struct.pack("<i", value), kind)


def everything(parameters: Parameters, until_s: float = 10.0) -> list[Outgoing]:
    """Return the messages of running lists, called every 20 ms."""
    outgoing: list[Outgoing] = []
    for tick in range(round(until_s / 0.02)):
        outgoing += parameters.handle_timer(0.02 * tick)
    return outgoing


# List


def test_a_list_holds_every_parameter_once_with_a_constant_count() -> None:
    parameters = ardupilot()
    ask(parameters, mavlink.MAVLink_param_request_list_message(1, 1))
    values = of_type(everything(parameters), Value)
    assert [value.param_id for value in values] == [spec.name for spec in SPECS]
    assert [value.param_index for value in values] == [0, 1, 2, 3]
    assert {value.param_count for value in values} == {4}


def test_px4_sends_its_hash_first_with_no_index() -> None:
    parameters = px4()
    ask(parameters, mavlink.MAVLink_param_request_list_message(1, 1))
    first, *others = of_type(everything(parameters), Value)
    assert (first.param_id, first.param_index, first.param_count) == (HASH_CHECK, NO_INDEX, 4)
    assert len(others) == 4


def test_setting_the_hash_ends_the_list() -> None:
    parameters = px4()
    ask(parameters, mavlink.MAVLink_param_request_list_message(1, 1))
    assert ask(parameters, set_whole(HASH_CHECK, 1)) == []
    assert everything(parameters) == []


def test_a_list_goes_only_to_the_channel_that_asked() -> None:
    parameters = px4()
    ask(parameters, mavlink.MAVLink_param_request_list_message(1, 1))
    assert {outgoing.to for outgoing in everything(parameters)} == {STATION_CHANNEL}


def test_two_lists_run_beside_each_other() -> None:
    parameters = px4()
    request = mavlink.MAVLink_param_request_list_message(1, 1)
    for partner in (STATION, COMPANION):
        parameters.handle(received(request, partner), partner, 0.0)
    targets = [outgoing.to for outgoing in everything(parameters)]
    assert targets.count(STATION_CHANNEL) == targets.count(COMPANION_CHANNEL) == 5


@pytest.mark.parametrize(("rules", "rate_hz"), [(PX4_RULES, 1000.0), (ARDUPILOT_RULES, 1500.0)])
def test_a_list_is_paced(rules: ParameterProfile, rate_hz: float) -> None:
    specs = tuple(ParamSpec(f"P{number}", INT32, number) for number in range(900))
    parameters = Parameters(ParameterStore(specs), rules, StatusTexts())
    ask(parameters, mavlink.MAVLink_param_request_list_message(1, 1))
    for tick in range(30):
        sent_count = len(parameters.handle_timer(0.02 * tick))
        assert sent_count <= rate_hz * 0.02 + 1


def test_after_a_pause_of_the_caller_a_list_comes_in_bounded_bursts() -> None:
    specs = tuple(ParamSpec(f"P{number}", INT32, number) for number in range(900))
    parameters = px4(specs)
    ask(parameters, mavlink.MAVLink_param_request_list_message(1, 1))
    assert len(parameters.handle_timer(100.0)) == 64


def test_nothing_is_due_when_no_list_runs() -> None:
    parameters = px4()
    assert parameters.handle_timer(100.0) == []


# Read


@pytest.mark.parametrize("rules", [PX4_RULES, ARDUPILOT_RULES])
def test_reading_by_index_tells_the_index(rules: ParameterProfile) -> None:
    (outgoing,) = ask(parameters_of(rules), read(index=1))
    value = sent(outgoing)
    assert isinstance(value, Value)
    assert (value.param_id, value.param_value, value.param_index) == ("ALTITUDE", 2.5, 1)
    assert outgoing.to == STATION_CHANNEL


def test_reading_by_name_tells_the_index_on_px4_and_65535_on_ardupilot() -> None:
    (of_px4,) = of_type(ask(px4(), read("ALTITUDE")), Value)
    (of_ardupilot,) = of_type(ask(ardupilot(), read("ALTITUDE")), Value)
    assert (of_px4.param_index, of_ardupilot.param_index) == (1, NO_INDEX)


def test_a_name_of_sixteen_characters_has_no_nul_and_is_found() -> None:
    (value,) = of_type(ask(px4(), read("SIXTEEN_LETTERS_")), Value)
    assert value.param_id == "SIXTEEN_LETTERS_"


def test_integers_are_bytewise_on_px4_and_cast_on_ardupilot() -> None:
    (of_px4,) = of_type(ask(px4(), read("SIXTEEN_LETTERS_")), Value)
    (of_ardupilot,) = of_type(ask(ardupilot(), read("SIXTEEN_LETTERS_")), Value)
    assert raw_of(of_px4) == struct.pack("<i", -7)
    assert of_ardupilot.param_value == -7.0
    assert of_px4.param_type == of_ardupilot.param_type == INT32


def test_the_hash_can_be_read_by_name() -> None:
    (value,) = of_type(ask(px4(), read(HASH_CHECK)), Value)
    assert value.param_index == NO_INDEX


@pytest.mark.parametrize("request_", [read("NOBODY"), read(index=4), read(index=-2)])
def test_an_unknown_parameter_is_silence(request_: Message) -> None:
    assert ask(ardupilot(), request_) == ask(px4(), request_) == []


def test_the_hash_is_silence_on_ardupilot() -> None:
    assert ask(ardupilot(), read(HASH_CHECK)) == []


# Set


@pytest.mark.parametrize("rules", [PX4_RULES, ARDUPILOT_RULES])
def test_a_change_is_reported_to_every_channel(rules: ParameterProfile) -> None:
    parameters = parameters_of(rules)
    outgoing, *more = ask(parameters, set_real("ALTITUDE", 7.5))
    assert len(more) == rules.echoes - 1
    value = sent(outgoing)
    assert outgoing.to is None
    assert isinstance(value, Value)
    assert (value.param_value, parameters.store["ALTITUDE"]) == (7.5, 7.5)


def test_an_equal_value_is_echoed_too() -> None:
    assert len(of_type(ask(ardupilot(), set_real("ALTITUDE", 2.5)), Value)) == 1


def test_px4_takes_an_integer_by_its_bytes() -> None:
    parameters = px4()
    ask(parameters, set_whole("SIXTEEN_LETTERS_", -1))
    assert parameters.store["SIXTEEN_LETTERS_"] == -1


def test_ardupilot_casts_to_its_own_type_whatever_the_client_says() -> None:
    parameters = ardupilot()
    (value,) = of_type(ask(parameters, set_real("ACTION", 4.0, kind=INT8)), Value)
    assert (value.param_value, value.param_type, parameters.store["ACTION"]) == (4.0, INT32, 4)


def test_px4_refuses_another_type_and_what_is_read_only_in_silence() -> None:
    parameters = px4()
    assert ask(parameters, set_whole("ACTION", 4, REAL32)) == []
    assert ask(parameters, setting("FLOWN", bytes(4), INT32)) == []
    assert (parameters.store["ACTION"], parameters.store["FLOWN"]) == (2, 0)


@pytest.mark.parametrize("value", [math.nan, math.inf, -0.5, 80.5])
def test_px4_stores_what_may_not_be(value: float) -> None:
    parameters = px4()
    (echo, _) = of_type(ask(parameters, set_real("ALTITUDE", value)), Value)
    assert echo.param_value == pytest.approx(value, nan_ok=True)
    again = px4().store
    again.load_text(parameters.store.to_text(), "stored")
    assert again["ALTITUDE"] == pytest.approx(value, nan_ok=True)


@pytest.mark.parametrize(
    ("asked", "stored"), [(300.0, 44), (-129.0, 127), (7.9, 7), (math.nan, 5), (math.inf, 5)]
)
def test_without_a_check_of_ranges_integers_wrap_and_nan_is_silence(
    asked: float, stored: int
) -> None:
    store = ParameterStore((ParamSpec("SMALL", ParamType(INT8), 5, 0, 9),))
    parameters = Parameters(store, ARDUPILOT_RULES, StatusTexts())
    outgoing = ask(parameters, set_real("SMALL", asked))
    echoes = [each.param_value for each in of_type(outgoing, Value)]
    assert echoes == [stored] * math.isfinite(asked)
    assert len(outgoing) == len(echoes)
    assert parameters.store["SMALL"] == stored
    again = ParameterStore(store.specs)
    again.load_text(store.to_text(), "vehicle.parm")
    assert again["SMALL"] == stored


def test_read_only_is_reported_by_ardupilot_with_the_old_value_and_a_text() -> None:
    outgoing = ask(ardupilot(), setting("FLOWN", bytes(4), INT32))
    assert len(of_type(outgoing, Value)) == len(of_type(outgoing, Text)) == 1
    assert "read-only" in of_type(outgoing, Text)[0].text


@pytest.mark.parametrize("rules", [PX4_RULES, ARDUPILOT_RULES])
def test_setting_never_creates_a_parameter(rules: ParameterProfile) -> None:
    parameters = parameters_of(rules)
    assert ask(parameters, set_real("NOBODY", 1.0)) == []
    assert parameters.store.index_of("NOBODY") is None


def test_the_vehicle_changes_what_is_read_only() -> None:
    parameters = px4()
    parameters.store.set("FLOWN", 12)
    (value,) = of_type(ask(parameters, read("FLOWN")), Value)
    assert raw_of(value) == struct.pack("<i", 12)


def test_a_change_is_reported_to_everyone() -> None:
    assert all(each.to is None for each in ask(px4(), set_real("ALTITUDE", 12.0)))


def test_other_messages_get_no_answer() -> None:
    assert ask(px4(), mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)) == []


def test_lists_at_a_time_are_bounded_and_a_running_one_may_begin_again() -> None:
    parameters = px4()
    request = received(mavlink.MAVLink_param_request_list_message(1, 1))
    for port in range(100):
        partner = Partner(Channel(0, ("127.0.0.1", port)), 255, 190)
        parameters.handle(request, partner, 0.0)
    parameters.handle(request, Partner(Channel(0, ("127.0.0.1", 0)), 255, 190), 5.0)
    assert len({outgoing.to for outgoing in parameters.handle_timer(5.0)}) == MAX_LISTS
