"""The companion's own parameters on the wire: list, read, set, refusals, and when."""

from __future__ import annotations

import struct

import pytest

from companion.config.schema import CompanionConfig
from companion.config.tunables import TUNABLES
from companion.guidance.phases import Phase
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.payloads import ParamEncoding, ParamType, raw_of, value_from_raw
from companion.planning.crossing import LatchedCrossing
from tests.unit.companion.link.wire import ARDUPILOT, OFFBOARD, STRANGER, Wire, heartbeat

Value = mavlink.MAVLink_param_value_message
Error = mavlink.MAVLink_param_error_message
STATION = MavCodec(255, 190)
NAMES = [tunable.name for tunable in TUNABLES]


def request_list(component: int = 191, system: int = 1) -> Message:
    return mavlink.MAVLink_param_request_list_message(system, component)


def request_read(name: str = "", index: int = -1, component: int = 191) -> Message:
    return mavlink.MAVLink_param_request_read_message(1, component, name.encode(), index)


def param_set(name: str, value: float, kind: int = 9, component: int = 191) -> Message:
    return mavlink.MAVLink_param_set_message(1, component, name.encode(), value, kind)


def set_integer(name: str, value: int) -> Message:
    real = struct.unpack("<f", struct.pack("<i", value))[0]
    return param_set(name, real, ParamType.INT32)


def values(messages: list[Message]) -> dict[str, float]:
    return {
        m.param_id: value_from_raw(raw_of(m), ParamType(m.param_type), ParamEncoding.BYTEWISE)
        for m in messages
        if isinstance(m, Value)
    }


def ask(wire: Wire, message: Message) -> list[Message]:
    return wire.say(message, sender=STATION)


def errors(messages: list[Message]) -> list[tuple[str, int, int]]:
    return [(m.param_id, m.param_index, m.error) for m in messages if isinstance(m, Error)]


@pytest.mark.parametrize("component", [191, 0])
def test_a_list_tells_every_parameter_once_a_few_per_tick(component: int) -> None:
    wire = Wire().bound()
    ask(wire, request_list(component))
    listed: list[Value] = []
    for _ in range(50):  # steps shorter than a tick
        answers = [m for m in wire.wait(0.02) if isinstance(m, Value)]
        assert len(answers) <= 2
        listed += answers
    assert [m.param_id for m in listed] == NAMES
    assert [m.param_index for m in listed] == list(range(len(NAMES)))
    assert {m.param_count for m in listed} == {len(NAMES)}
    assert values(list(listed))["CMP_SPEED"] == 5.0
    assert values(list(listed))["CMP_ON_FOUND"] == 0


def test_names_fit_the_wire_and_are_in_order() -> None:
    assert all(len(name) <= 16 for name in NAMES)
    assert sorted(NAMES) == NAMES


def test_a_parameter_is_read_by_name_and_by_index() -> None:
    wire = Wire().bound()
    assert values(ask(wire, request_read("CMP_ALTITUDE"))) == {"CMP_ALTITUDE": 20.0}
    assert list(values(ask(wire, request_read(index=1)))) == [NAMES[1]]


def test_what_does_not_exist_is_refused_and_never_made() -> None:
    wire = Wire().bound()
    assert errors(ask(wire, request_read("CMP_NOTHING"))) == [("CMP_NOTHING", -1, 1)]
    assert errors(ask(wire, request_read(index=99))) == [("", 99, 1)]
    sent = ask(wire, param_set("CMP_NOTHING", 1.0))
    assert errors(sent) == [("CMP_NOTHING", -1, 1)]
    assert values(sent) == {}


def test_what_is_meant_for_others_is_left_to_them() -> None:
    wire = Wire().bound()
    assert ask(wire, param_set("COM_OF_LOSS_T", 1.0, component=0)) == []
    assert ask(wire, request_read("COM_OF_LOSS_T", component=0)) == []
    assert ask(wire, param_set("CMP_SPEED", 2.0, component=1)) == []
    ask(wire, request_list(component=1))
    ask(wire, request_list(system=7))
    assert values(wire.wait(1.0)) == {}


def test_a_change_is_reported_noted_and_flown() -> None:
    wire = Wire().bound()
    sent = ask(wire, param_set("CMP_SPEED", 2.5))
    assert values(sent) == {"CMP_SPEED": 2.5}
    assert wire.endpoint.session.context.guard.limits.envelope.speed_mps == 2.5
    noted = [fields for kind, fields in wire.journal.records if kind == "parameter"]
    assert noted == [{"name": "CMP_SPEED", "old": 5.0, "new": 2.5, "sender": (255, 190)}]
    assert "parameter CMP_SPEED: 5 -> 2.5" in wire.journal.texts


def test_every_part_of_the_session_takes_a_change() -> None:
    wire = Wire().bound()
    for name, value in (("CMP_ALTITUDE", 30.0), ("CMP_STOP_RADIUS", 2.0), ("CMP_OVER_MIN", 4.0)):
        assert values(ask(wire, param_set(name, value))) == {name: value}
    session = wire.endpoint.session
    assert session.params.altitude_m == 30.0
    assert session.params.stop_radius_m == 2.0
    assert session.steering.altitude_m == session.flight_plan._altitude_m == 30.0
    planner = session.flight_plan._planner
    assert isinstance(planner, LatchedCrossing)
    assert planner.params.overshoot_min_m == 4.0


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("CMP_SPEED", 5.5),
        ("CMP_SPEED", 0.0),
        ("CMP_SPEED", float("nan")),
        ("CMP_SPEED", float("inf")),
        ("CMP_ALTITUDE", 59.5),
        ("CMP_ALTITUDE", -1.0),
        ("CMP_OVER_MIN", 25.0),
        ("CMP_STOP_RADIUS", 1e-3),
        ("CMP_BAT_LOW", 19.5),
        ("CMP_BAT_LOW", 101.0),
        ("CMP_BAT_LOW", float("nan")),
        ("CMP_BAT_CRIT", 9.0),
        ("CMP_BAT_CRIT", 21.0),
        ("CMP_BAT_RESERVE", 15.0),
        ("CMP_BAT_RESERVE", 100.0),
    ],
)
def test_what_the_configuration_would_refuse_is_refused(name: str, value: float) -> None:
    wire = Wire().bound()
    before = values(ask(wire, request_read(name)))
    sent = ask(wire, param_set(name, value))
    assert values(sent) == before
    assert [(who, error) for who, _, error in errors(sent)] == [(name, 2)]
    assert wire.journal.texts[-1].startswith(f"parameter {name}: ")


@pytest.mark.parametrize("name", [tunable.name for tunable in TUNABLES if not tunable.choices])
@pytest.mark.parametrize(
    "value", [1e30, -1e30, 3.4e38, 1e-30, 1e-45, *map(float, ("nan", "inf", "-inf"))]
)
def test_every_parameter_has_a_range_that_an_absurd_value_is_outside_of(
    name: str, value: float
) -> None:
    wire = Wire().bound()
    before = values(ask(wire, request_read(name)))
    config = wire.endpoint._parameters._book.config  # type: ignore[attr-defined]
    sent = ask(wire, param_set(name, value))
    assert values(sent) == before
    assert [who for who, _, _ in errors(sent)] == [name]
    assert wire.journal.texts[-1].startswith(f"parameter {name}: ")
    assert wire.endpoint._parameters._book.config == config  # type: ignore[attr-defined]


def test_a_limit_is_raised_again_as_far_as_the_file_has_it() -> None:
    wire = Wire(CompanionConfig()).bound()
    ask(wire, param_set("CMP_SPEED", 1.0))
    assert values(ask(wire, param_set("CMP_SPEED", 5.0))) == {"CMP_SPEED": 5.0}
    assert wire.endpoint.session.context.guard.limits.envelope.speed_mps == 5.0


def test_charge_for_the_way_home_is_raised_and_lowered_again_as_far_as_the_file_has_it() -> None:
    wire = Wire(CompanionConfig()).bound()
    session = wire.endpoint.session
    for low_pct, critical_pct, reserve_pct in ((40.0, 30.0, 50.0), (20.0, 20.0, 20.0)):
        for name, value in (
            ("CMP_BAT_LOW", low_pct),
            ("CMP_BAT_CRIT", critical_pct),
            ("CMP_BAT_RESERVE", reserve_pct),
        ):
            if (name, value) == ("CMP_BAT_LOW", 20.0):  # not below what is critical
                assert values(ask(wire, param_set(name, value))) == {name: 40.0}
                ask(wire, param_set("CMP_BAT_CRIT", 20.0))
            assert values(ask(wire, param_set(name, value))) == {name: value}
        assert session.params.battery_low_pct == low_pct
        assert session.params.battery_critical_pct == critical_pct
        reserve = session.context.guard.limits.reserve
        assert reserve is not None
        assert reserve.reserve_pct == reserve_pct


def test_the_fence_is_read_only() -> None:
    wire = Wire().bound()
    sent = ask(wire, param_set("CMP_FENCE_MARGIN", 1.0))
    assert values(sent) == {"CMP_FENCE_MARGIN": 3.0}
    assert [error for _, _, error in errors(sent)] == [5]


def test_what_ends_a_flight_is_chosen_before_it() -> None:
    wire = Wire().bound()
    assert values(ask(wire, set_integer("CMP_ON_FOUND", 2))) == {"CMP_ON_FOUND": 2}
    assert wire.endpoint.session.params.on_localised == "land"
    wire.ready(OFFBOARD)
    sent = ask(wire, set_integer("CMP_ON_FOUND", 0))
    assert values(sent) == {"CMP_ON_FOUND": 2}
    assert [error for _, _, error in errors(sent)] == [3]


def test_a_choice_has_no_other_values() -> None:
    wire = Wire().bound()
    sent = ask(wire, set_integer("CMP_ON_FOUND", 3))
    assert values(sent) == {"CMP_ON_FOUND": 0}
    assert [error for _, _, error in errors(sent)] == [2]


@pytest.mark.parametrize(("kind", "error"), [(ParamType.INT32, 7), (ParamType.UINT8, 6)])
def test_a_value_of_another_type_is_refused(kind: int, error: int) -> None:
    wire = Wire().bound()
    sent = ask(wire, param_set("CMP_SPEED", 2.0, kind))
    assert [code for _, _, code in errors(sent)] == [error]
    assert values(sent) == {"CMP_SPEED": 5.0}


def test_speed_may_change_in_flight() -> None:
    wire = Wire().ready(OFFBOARD)
    assert wire.endpoint.session.phase is Phase.HOLD
    assert values(ask(wire, param_set("CMP_SPEED", 2.0))) == {"CMP_SPEED": 2.0}


def test_a_stranger_changes_nothing() -> None:
    wire = Wire().bound()
    sent = wire.say(param_set("CMP_SPEED", 2.0), sender=STATION, peer=STRANGER)
    assert sent == []
    assert wire.endpoint.session.context.guard.limits.envelope.speed_mps == 5.0


def test_a_flood_of_reads_is_answered_in_part() -> None:
    wire = Wire().bound()
    answers = [m for _ in range(500) for m in ask(wire, request_read("CMP_SPEED"))]
    assert 0 < len([m for m in answers if isinstance(m, Value)]) <= 100


@pytest.mark.parametrize("autopilot", [12, ARDUPILOT])
def test_integers_go_as_autopilot_version_says(autopilot: int) -> None:
    wire = Wire()
    wire.say(heartbeat(autopilot))
    command = mavlink.MAVLink_command_long_message(1, 191, 512, 0, 148.0, *(0.0,) * 6)
    version = [
        m for m in ask(wire, command) if isinstance(m, mavlink.MAVLink_autopilot_version_message)
    ]
    ask(
        wire,
        param_set("CMP_ON_FOUND", 2.0, ParamType.INT32)
        if autopilot == ARDUPILOT
        else set_integer("CMP_ON_FOUND", 2),
    )
    answers = [m for m in ask(wire, request_read("CMP_ON_FOUND")) if isinstance(m, Value)]
    encoding = ParamEncoding.C_CAST if autopilot == ARDUPILOT else ParamEncoding.BYTEWISE
    flag = 131072 if autopilot == ARDUPILOT else 16
    assert version[0].capabilities & (131072 | 16) == flag
    assert value_from_raw(raw_of(answers[0]), ParamType.INT32, encoding) == 2


def test_a_ground_station_on_its_own_link_is_served_there() -> None:
    wire = Wire(gcs_links=1).bound()
    wire.say(param_set("CMP_SPEED", 3.0), sender=STATION, peer=None, link=1)
    assert wire.endpoint.session.context.guard.limits.envelope.speed_mps == 3.0
    answers = [c for c in wire.raw if c.link == 1]
    kinds = {m.get_type() for c in answers for m in wire.reader.decode(c.data)}
    assert {"PARAM_VALUE", "STATUSTEXT"} <= kinds
    wire.wait(2.0)
    kinds = {m.get_type() for c in wire.raw if c.link == 1 for m in MavCodec(9, 9).decode(c.data)}
    assert "HEARTBEAT" in kinds
    assert not kinds & {"COMMAND_LONG", "SET_POSITION_TARGET_LOCAL_NED", "TIMESYNC"}


def test_a_ground_stations_own_link_cannot_grant_control() -> None:
    wire = Wire(gcs_links=1).bound()
    command = mavlink.MAVLink_command_long_message(1, 191, 92, 0, 1.0, *(0.0,) * 6)
    acks = wire.say(command, sender=STATION, peer=None, link=1)
    results = [m.result for m in acks if isinstance(m, mavlink.MAVLink_command_ack_message)]
    assert set(results) == {mavlink.MAV_RESULT_DENIED}
