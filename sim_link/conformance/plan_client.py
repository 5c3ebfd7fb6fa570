"""The client's side of the mission protocol, in steps that a probe can each do wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from companion.mav.dialect import Message, mavlink
from sim_link.conformance.rules import Violation, require
from sim_link.conformance.vehicle_probe import VehicleProbe
from sim_link.conformance.vehicle_station import NAN

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
class PlanItem:
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


def item_of(message: Item) -> PlanItem:
    """The item of a downloaded message."""
    return PlanItem(
        message.command,
        message.frame,
        (message.param1, message.param2, message.param3, message.param4),
        message.x,
        message.y,
        message.z,
        message.current,
        message.autocontinue,
    )


def waypoint(lat_e7: int, lon_e7: int, height_m: float) -> PlanItem:
    """NAV_WAYPOINT at a height above home."""
    return PlanItem(mavlink.MAV_CMD_NAV_WAYPOINT, x=lat_e7, y=lon_e7, z=height_m)


def send_count(probe: VehicleProbe, count: int, kind: int) -> int:
    """MISSION_COUNT; the mark before it."""
    mark = probe.mark
    probe.send(mavlink.MAVLink_mission_count_message(*probe.target, count, kind))
    return mark


def await_request(
    probe: VehicleProbe, mark: int, sequence: int | None = None, within_s: float = STEP_TIMEOUT_S
) -> Request:
    """The next request of an item, with either message.

    Raises:
        Violation: Another message, or nothing, came.
    """
    found: list[Message] = []

    def is_there() -> bool:
        """Whether a message of the transfer came."""
        for entry in probe.inbox[mark + len(found) :]:
            found.append(entry.message)
            if isinstance(entry.message, (*REQUESTS, Ack)):
                return True
        return False

    if not probe.run_until(is_there, within_s):
        raise Violation(f"no request of an item within {within_s:g} s")
    last = found[-1]
    if isinstance(last, Ack):
        raise Violation(f"ACK {last.type} instead of a request")
    assert isinstance(last, REQUESTS)
    require(sequence in (None, last.seq), f"item {last.seq} requested, not {sequence}")
    return last


def await_ack(probe: VehicleProbe, mark: int, within_s: float = STEP_TIMEOUT_S) -> int:
    """The type of the next MISSION_ACK for us."""
    ack = probe.expect(
        Ack,
        lambda m: m.target_system in (0, probe.system_id),
        mark=mark,
        within_s=within_s,
    )
    return int(ack.type)


def upload(probe: VehicleProbe, items: Sequence[PlanItem], kind: int = MISSION) -> int:
    """A whole upload; the type of its MISSION_ACK."""
    mark = send_count(probe, len(items), kind)
    for _ in range(20 * len(items) + 20):
        step = next_step(probe, mark)
        if isinstance(step, Ack):
            return int(step.type)
        require(step.seq < len(items), f"item {step.seq} of {len(items)} requested")
        mark = probe.mark
        probe.send(items[step.seq].message(probe, step.seq, kind))
    raise Violation("the upload does not end")


def next_step(probe: VehicleProbe, mark: int) -> Request | Ack:
    """The vehicle's next request or ACK."""
    cursor = mark
    found: list[Request | Ack] = []

    def is_there() -> bool:
        """Whether a message of the transfer came."""
        nonlocal cursor
        while cursor < len(probe.inbox) and not found:
            message = probe.inbox[cursor].message
            cursor += 1
            if isinstance(message, (*REQUESTS, Ack)):
                found.append(message)
        return bool(found)

    if not probe.run_until(is_there, STEP_TIMEOUT_S):
        raise Violation(f"neither request nor ACK within {STEP_TIMEOUT_S:g} s")
    return found[0]


def require_upload(probe: VehicleProbe, items: Sequence[PlanItem], kind: int = MISSION) -> None:
    """A whole upload, which must be accepted."""
    result = upload(probe, items, kind)
    require(result == 0, f"an upload of {len(items)} items of type {kind} gave ACK {result}")


def begin_download(probe: VehicleProbe, kind: int = MISSION) -> int:
    """MISSION_REQUEST_LIST; how many items there are."""
    mark = probe.mark
    probe.send(mavlink.MAVLink_mission_request_list_message(*probe.target, kind))
    return probe.expect(
        Count, lambda m: m.mission_type == kind, mark=mark, within_s=STEP_TIMEOUT_S
    ).count


def download(probe: VehicleProbe, kind: int = MISSION) -> list[PlanItem]:
    """A whole download, with the client's ACK at its end."""
    count = begin_download(probe, kind)
    items = [request_item(probe, sequence, kind) for sequence in range(count)]
    finish_download(probe, kind)
    return items


def request_item(probe: VehicleProbe, sequence: int, kind: int) -> PlanItem:
    """MISSION_REQUEST_INT; the item."""
    mark = probe.mark
    probe.send(mavlink.MAVLink_mission_request_int_message(*probe.target, sequence, kind))
    item = probe.expect(
        Item,
        lambda m: m.seq == sequence and m.mission_type == kind,
        mark=mark,
        within_s=STEP_TIMEOUT_S,
    )
    return item_of(item)


def finish_download(probe: VehicleProbe, kind: int) -> None:
    """The client's ACK."""
    probe.send(mavlink.MAVLink_mission_ack_message(*probe.target, 0, kind))


def clear(probe: VehicleProbe, kind: int = MISSION) -> int:
    """MISSION_CLEAR_ALL; the type of its ACK."""
    mark = probe.mark
    probe.send(mavlink.MAVLink_mission_clear_all_message(*probe.target, kind))
    return await_ack(probe, mark)


def with_home(probe: VehicleProbe, items: Sequence[PlanItem]) -> list[PlanItem]:
    """A mission as the flavour numbers it: ArduPilot's item 0 is home."""
    if probe.is_px4:
        return list(items)
    home = PlanItem(mavlink.MAV_CMD_NAV_WAYPOINT, mavlink.MAV_FRAME_GLOBAL, (0.0, 0.0, 0.0, 0.0))
    return [home, *items]


def without_home(probe: VehicleProbe, items: Sequence[PlanItem]) -> list[PlanItem]:
    """A downloaded mission without ArduPilot's item 0."""
    return list(items) if probe.is_px4 else list(items[1:])


def changed(item: PlanItem, **what: object) -> PlanItem:
    """The item with some fields changed."""
    return replace(item, **what)  # type: ignore[arg-type]
