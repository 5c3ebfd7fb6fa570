"""Clients of the parameter and mission protocols, in steps that a probe can each do wrong.

Parameter values are kept as the bytes on the wire. Plans lie about home.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from companion.mav.dialect import Message, mavlink
from sim_link.lab.conformance.rules import Violation, require
from sim_link.lab.conformance.station import Heard
from sim_link.lab.conformance.vehicle_probe import NAN, VehicleProbe

SERVICE = "MAVLink guide, Parameter Protocol"
STRICT = "(stricter than the real one)"
INT32, REAL32 = 6, 9
PX4_NAMES = (
    "MIS_TAKEOFF_ALT",
    "RTL_RETURN_ALT",
    "COM_OF_LOSS_T",
    "COM_OBL_RC_ACT",
    "MPC_XY_VEL_MAX",
    "SYS_AUTOSTART",
)
ARDUPILOT_NAMES = ("RTL_ALT", "FENCE_ENABLE", "FS_GCS_ENABLE", "GUID_TIMEOUT", "SYSID_MYGCS")
UNLISTED_INDEX = 65_535
Value = mavlink.MAVLink_param_value_message
Error = mavlink.MAVLink_param_error_message
LIST_S = 60.0
ANSWER_S = 2.0


@dataclass(frozen=True, slots=True)
class Parameter:
    """One PARAM_VALUE, its value kept as the four bytes on the wire."""

    name: str
    kind: int
    raw: bytes
    index: int
    count: int

    def value(self, probe: VehicleProbe) -> float:
        """The number, decoded as the flavour encodes."""
        if probe.is_px4 and self.kind == INT32:
            return float(struct.unpack("<i", self.raw)[0])
        return float(struct.unpack("<f", self.raw)[0])


def parameter(entry: Heard) -> Parameter:
    """The parameter of a heard PARAM_VALUE."""
    message = entry.message
    assert isinstance(message, Value)
    start = 10 if entry.frame[0] == 0xFD else 6
    payload = entry.frame[start : start + entry.frame[1]].ljust(25, b"\0")
    return Parameter(
        message.param_id, message.param_type, payload[:4], message.param_index, message.param_count
    )


def encode(probe: VehicleProbe, value: float, kind: int) -> float:
    """The float field that carries a value."""
    if probe.is_px4 and kind == INT32:
        return float(struct.unpack("<f", struct.pack("<i", int(value)))[0])
    return value


def values_since(probe: VehicleProbe, mark: int, name: str | None = None) -> list[Parameter]:
    """The parameters told since a mark."""
    found = [
        parameter(entry)
        for entry in probe.inbox[mark:]
        if isinstance(entry.message, Value) and entry.source == probe.target
    ]
    return [p for p in found if name in (None, p.name)]


def await_value(probe: VehicleProbe, mark: int, name: str) -> Parameter:
    """The next value of a parameter."""
    told = probe.run_until(lambda: bool(values_since(probe, mark, name)), ANSWER_S)
    require(told, f"no PARAM_VALUE of {name} within {ANSWER_S:g} s")
    return values_since(probe, mark, name)[-1]


@contextmanager
def restored(probe: VehicleProbe, name: str) -> Iterator[Parameter]:
    """A parameter as it is; at the end it is written back."""
    before = read(probe, name)
    try:
        yield before
    finally:
        write(probe, name, before.value(probe), before.kind)
        probe.run(0.2)


@contextmanager
def parameter_set(probe: VehicleProbe, name: str, value: float) -> Iterator[None]:
    """A parameter that has another value for a while."""
    with restored(probe, name) as before:
        await_value(probe, write(probe, name, value, before.kind), name)
        yield


def request_read(probe: VehicleProbe, name: str, index: int = -1) -> int:
    """PARAM_REQUEST_READ by name or index; the mark before it."""
    mark = probe.mark
    message = mavlink.MAVLink_param_request_read_message(*probe.target, name.encode(), index)
    probe.send(message)
    return mark


def read(probe: VehicleProbe, name: str) -> Parameter:
    """PARAM_REQUEST_READ by name."""
    return await_value(probe, request_read(probe, name), name)


def write(
    probe: VehicleProbe, name: str, value: float, kind: int, target: tuple[int, int] | None = None
) -> int:
    """PARAM_SET; the mark before it."""
    mark = probe.mark
    field = encode(probe, value, kind) if math.isfinite(value) else value
    probe.send(
        mavlink.MAVLink_param_set_message(*(target or probe.target), name.encode(), field, kind)
    )
    return mark


def read_all(probe: VehicleProbe) -> list[Parameter]:
    """PARAM_REQUEST_LIST; every parameter once, by index."""
    mark = probe.mark
    probe.send(mavlink.MAVLink_param_request_list_message(*probe.target))
    seen: dict[int, Parameter] = {}
    cursor = mark

    def is_complete() -> bool:
        """Whether every index was told."""
        nonlocal cursor
        for entry in probe.inbox[cursor:]:
            cursor += 1
            if isinstance(entry.message, Value) and entry.source == probe.target:
                told = parameter(entry)
                if told.index != UNLISTED_INDEX:
                    seen[told.index] = told
        return bool(seen) and len(seen) == next(iter(seen.values())).count

    if not probe.run_until(is_complete, LIST_S):
        raise Violation(f"{len(seen)} parameters within {LIST_S:g} s, incomplete")
    return [seen[index] for index in sorted(seen)]


def float_name(probe: VehicleProbe) -> str:
    """A REAL32 parameter that may be changed a little."""
    return "MIS_TAKEOFF_ALT" if probe.is_px4 else "GUID_TIMEOUT"


def integer_name(probe: VehicleProbe) -> str:
    """An integer parameter that may be 3."""
    return "COM_OBL_RC_ACT" if probe.is_px4 else "FS_GCS_ENABLE"


MISSION = mavlink.MAV_MISSION_TYPE_MISSION
FENCE = mavlink.MAV_MISSION_TYPE_FENCE
RALLY = mavlink.MAV_MISSION_TYPE_RALLY
ALL = mavlink.MAV_MISSION_TYPE_ALL
STEP_TIMEOUT_S = 4.0

Request = mavlink.MAVLink_mission_request_message | mavlink.MAVLink_mission_request_int_message
REQUESTS = (mavlink.MAVLink_mission_request_message, mavlink.MAVLink_mission_request_int_message)
Ack = mavlink.MAVLink_mission_ack_message
Item = mavlink.MAVLink_mission_item_int_message
Count = mavlink.MAVLink_mission_count_message


@dataclass(frozen=True, slots=True)
class MissionItem:
    """One MISSION_ITEM_INT without its addresses."""

    command: int
    frame: int = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
    params: tuple[float, float, float, float] = (0.0, 0.0, 0.0, NAN)
    x: int = 0
    y: int = 0
    z: float = 0.0
    current: int = 0
    autocontinue: int = 1

    def message(self, probe: VehicleProbe, sequence: int, kind: int) -> Message:
        """The message that uploads it."""
        return mavlink.MAVLink_mission_item_int_message(
            *probe.target,
            sequence,
            self.frame,
            self.command,
            self.current,
            self.autocontinue,
            *self.params,
            self.x,
            self.y,
            self.z,
            kind,
        )


def item_of(message: Item) -> MissionItem:
    """The item of a downloaded message."""
    return MissionItem(
        message.command,
        message.frame,
        (message.param1, message.param2, message.param3, message.param4),
        message.x,
        message.y,
        message.z,
        message.current,
        message.autocontinue,
    )


def waypoint(lat_e7: int, lon_e7: int, height_m: float) -> MissionItem:
    """NAV_WAYPOINT at a height above home."""
    return MissionItem(mavlink.MAV_CMD_NAV_WAYPOINT, x=lat_e7, y=lon_e7, z=height_m)


def send_count(probe: VehicleProbe, count: int, kind: int) -> int:
    """MISSION_COUNT; the mark before it."""
    mark = probe.mark
    probe.send(mavlink.MAVLink_mission_count_message(*probe.target, count, kind))
    return mark


def await_request(probe: VehicleProbe, mark: int, sequence: int) -> Request:
    """The next request of an item, with either message."""
    last = next_step(probe, mark)
    if isinstance(last, Ack):
        raise Violation(f"ACK {last.type} instead of a request")
    require(sequence == last.seq, f"item {last.seq} requested, not {sequence}")
    return last


def await_ack(probe: VehicleProbe, mark: int) -> int:
    """The type of the next MISSION_ACK for us."""
    ids = (0, probe.system_id)
    ack = probe.expect(Ack, lambda m: m.target_system in ids, mark=mark, within_s=STEP_TIMEOUT_S)
    return int(ack.type)


def result_of(probe: VehicleProbe, message: Message) -> int:
    """Send a message; the type of the MISSION_ACK that follows."""
    mark = probe.mark
    probe.send(message)
    return await_ack(probe, mark)


def send_item(probe: VehicleProbe, item: MissionItem, sequence: int, kind: int = MISSION) -> int:
    """One item; the mark before it."""
    mark = probe.mark
    probe.send(item.message(probe, sequence, kind))
    return mark


def begin_upload(probe: VehicleProbe, count: int) -> int:
    """MISSION_COUNT, and the request of the first item; the mark before both."""
    mark = send_count(probe, count, MISSION)
    await_request(probe, mark, 0)
    return mark


def upload(probe: VehicleProbe, items: Sequence[MissionItem], kind: int = MISSION) -> int:
    """A whole upload; the type of its MISSION_ACK."""
    mark = send_count(probe, len(items), kind)
    for _ in range(20 * len(items) + 20):
        step = next_step(probe, mark)
        if isinstance(step, Ack):
            return int(step.type)
        require(step.seq < len(items), f"item {step.seq} of {len(items)} requested")
        mark = send_item(probe, items[step.seq], step.seq, kind)
    raise Violation("the upload does not end")


def next_step(probe: VehicleProbe, mark: int) -> Request | Ack:
    """The vehicle's next request or ACK."""
    kinds = (*REQUESTS, Ack)
    step = probe.expect(kinds, mark=mark, within_s=STEP_TIMEOUT_S, what="request or MISSION_ACK")
    assert isinstance(step, kinds)
    return step


def require_upload(probe: VehicleProbe, items: Sequence[MissionItem], kind: int = MISSION) -> None:
    """A whole upload, which must be accepted."""
    result = upload(probe, items, kind)
    require(result == 0, f"an upload of {len(items)} items of type {kind} gave ACK {result}")


def begin_download(probe: VehicleProbe, kind: int = MISSION) -> int:
    """MISSION_REQUEST_LIST; how many items there are."""
    request = mavlink.MAVLink_mission_request_list_message(*probe.target, kind)
    answer = probe.ask(request, Count, lambda m: m.mission_type == kind, within_s=STEP_TIMEOUT_S)
    return int(answer.count)


def download(probe: VehicleProbe, kind: int = MISSION) -> list[MissionItem]:
    """A whole download, with the client's ACK at its end."""
    count = begin_download(probe, kind)
    items = [request_item(probe, sequence, kind) for sequence in range(count)]
    finish_download(probe, kind)
    return items


def request_item(probe: VehicleProbe, sequence: int, kind: int) -> MissionItem:
    """MISSION_REQUEST_INT; the item."""
    item = probe.ask(
        mavlink.MAVLink_mission_request_int_message(*probe.target, sequence, kind),
        Item,
        lambda m: m.seq == sequence and m.mission_type == kind,
        within_s=STEP_TIMEOUT_S,
    )
    return item_of(item)


def finish_download(probe: VehicleProbe, kind: int) -> None:
    """The client's ACK."""
    probe.send(mavlink.MAVLink_mission_ack_message(*probe.target, 0, kind))


def clear(probe: VehicleProbe, kind: int = MISSION) -> int:
    """MISSION_CLEAR_ALL; the type of its ACK."""
    return result_of(probe, mavlink.MAVLink_mission_clear_all_message(*probe.target, kind))


def with_home(probe: VehicleProbe, items: Sequence[MissionItem]) -> list[MissionItem]:
    """A mission as the flavour numbers it: ArduPilot's item 0 is home."""
    if probe.is_px4:
        return list(items)
    home = MissionItem(mavlink.MAV_CMD_NAV_WAYPOINT, mavlink.MAV_FRAME_GLOBAL, (0.0, 0.0, 0.0, 0.0))
    return [home, *items]


def without_home(probe: VehicleProbe, items: Sequence[MissionItem]) -> list[MissionItem]:
    """A downloaded mission without ArduPilot's item 0."""
    return list(items) if probe.is_px4 else list(items[1:])


def square(probe: VehicleProbe, count: int = 4, height_m: float = 10.0) -> list[MissionItem]:
    """Waypoints about home, 20 m apart; ArduPilot's home item first."""
    home = probe.home()
    offsets = [(1_800, 0), (1_800, 2_600), (0, 2_600), (0, 0)]
    items = []
    for number in range(count):
        north, east = offsets[number % 4]
        items.append(waypoint(home.latitude + north, home.longitude + east, height_m + number))
    return with_home(probe, items)


def stored(probe: VehicleProbe) -> list[MissionItem]:
    """The mission that the vehicle has, without ArduPilot's home item."""
    return without_home(probe, download(probe))


def places(items: Sequence[MissionItem]) -> list[tuple[int, int, int, float]]:
    """What must survive a round trip on either flavour."""
    return [(item.command, item.x, item.y, round(item.z, 3)) for item in items]


def require_stored(probe: VehicleProbe, wanted: Sequence[MissionItem]) -> None:
    """The vehicle must have this mission, ArduPilot's home item aside."""
    found = places(stored(probe))
    require(found == places(wanted), f"the mission is {found}, not {places(wanted)}")


def prepare(probe: VehicleProbe, count: int = 3) -> list[MissionItem]:
    """Get ready and upload a mission; the items without home."""
    probe.get_ready()
    items = square(probe, count)
    require_upload(probe, items)
    return without_home(probe, items)


def circle(probe: VehicleProbe, radius_m: float = 500.0) -> list[MissionItem]:
    """A circular inclusion fence about home."""
    home, command = probe.home(), mavlink.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION
    params = (radius_m, 0.0, 0.0, 0.0)
    return [MissionItem(command, fence_frame(probe), params, home.latitude, home.longitude)]


def fence_frame(probe: VehicleProbe) -> int:
    """In which frame the flavour's clients send a fence."""
    return mavlink.MAV_FRAME_GLOBAL_INT if probe.is_px4 else mavlink.MAV_FRAME_GLOBAL


def polygon(probe: VehicleProbe, told: float = 4.0, half: int = 30_000) -> list[MissionItem]:
    """A square inclusion fence about home, each vertex telling `told` vertices."""
    home = probe.home()
    corners = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    return [
        MissionItem(
            mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION,
            fence_frame(probe),
            (told, 0.0, 0.0, 0.0),
            home.latitude + north * half,
            home.longitude + east * half,
        )
        for north, east in corners
    ]


def rally(probe: VehicleProbe) -> list[MissionItem]:
    """One rally point near home."""
    home, command = probe.home(), mavlink.MAV_CMD_NAV_RALLY_POINT
    frame = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
    if not probe.is_px4:
        frame = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT
    place = (home.latitude + 900, home.longitude, 15.0)
    return [MissionItem(command, frame, (0.0, 0.0, 0.0, 0.0), *place)]
