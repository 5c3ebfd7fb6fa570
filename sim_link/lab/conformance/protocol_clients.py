"""Clients of a vehicle's parameters, plans and setpoints, in single steps that a rule can vary.

Answers are searched after the latest transmission. Parameter values are kept as the bytes on the
wire. Plans lie around home.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

from companion.mav.dialect import Message, mavlink
from sim_link.lab.conformance import mavlink_oracle as mav
from sim_link.lab.conformance.mavlink_oracle import GlobalSetpoint, LocalSetpoint, Triple
from sim_link.lab.conformance.rules import NotApplicable, Violation, require
from sim_link.lab.conformance.station import Heard, Parameter
from sim_link.lab.conformance.vehicle_probe import VehicleProbe

UNLISTED_INDEX = 65_535
LIST_S = 60.0
ANSWER_S = 2.0


class ParameterClient(VehicleProbe):
    """Reads and writes parameters, and records changes in the baseline."""

    @property
    def float_name(self) -> str:
        """A REAL32 parameter that may be changed a little."""
        return "MIS_TAKEOFF_ALT" if self.is_px4 else "GUID_TIMEOUT"

    @property
    def integer_name(self) -> str:
        """An integer parameter that may be 3."""
        return "COM_OBL_RC_ACT" if self.is_px4 else "FS_GCS_ENABLE"

    def parameter(self, entry: Heard) -> Parameter:
        """Return the parameter of a heard PARAM_VALUE."""
        m = entry.message
        assert isinstance(m, mav.ParamValue)
        raw = entry.payload.ljust(4, b"\0")[:4]
        code = "<i" if self.is_px4 and m.param_type == mav.INT32 else "<f"
        value = float(struct.unpack(code, raw)[0])
        return Parameter(m.param_id, m.param_type, raw, m.param_index, m.param_count, value)

    def values_since(self, mark: int, name: str | None = None) -> list[Parameter]:
        """Return the parameters received since a mark."""
        found = [
            self.parameter(entry)
            for entry in self.inbox[mark:]
            if isinstance(entry.message, mav.ParamValue) and entry.source == self.target
        ]
        return [p for p in found if name in (None, p.name)]

    def await_value(self, name: str) -> Parameter:
        """Return the value of a parameter that is reported after a request."""
        mark = self.asked
        is_heard = self.run_until(lambda: bool(self.values_since(mark, name)), ANSWER_S)
        require(is_heard, f"no PARAM_VALUE of {name} within {ANSWER_S:g} s")
        return self.values_since(mark, name)[-1]

    def remember(self, name: str) -> Parameter:
        """Return the parameter's value before the rules."""
        known = self.baseline.parameters
        if name not in known:
            known[name] = self.read(name)
        return known[name]

    def change(self, name: str, value: float) -> Parameter:
        """Change a parameter until the rule is over; return the reported value."""
        self.write(name, value, self.remember(name).kind)
        return self.await_value(name)

    def put_back(self, name: str) -> None:
        """Give a parameter the value that it had; `Violation`: the vehicle does not take it."""
        before = self.baseline.parameters[name]
        if self.read(name).raw != before.raw:
            kind = bytes((before.kind,))
            body = before.raw + bytes(self.target) + name.encode().ljust(16, b"\0") + kind
            self.send_payload(mav.ParamSet, body)
            require(self.await_value(name).raw == before.raw, f"{name} keeps another value")
        del self.baseline.parameters[name]

    def request_read(self, name: str, index: int = -1) -> None:
        """Send PARAM_REQUEST_READ by name or index."""
        self.send(mav.ParamRead(*self.target, name.encode(), index))

    def read(self, name: str) -> Parameter:
        """Return a parameter, read by name."""
        self.request_read(name)
        return self.await_value(name)

    def write(
        self, name: str, value: float, kind: int, target: tuple[int, int] | None = None
    ) -> None:
        """Send PARAM_SET, encoded as the flavour does."""
        with suppress(Violation):  # there is no such parameter
            self.remember(name)
        if self.is_px4 and kind == mav.INT32 and math.isfinite(value):
            value = struct.unpack("<f", struct.pack("<i", int(value)))[0]
        self.send(mav.ParamSet(*(target or self.target), name.encode(), value, kind))

    def read_all(self) -> list[Parameter]:
        """Send PARAM_REQUEST_LIST; return every parameter once, by index."""
        seen: dict[int, Parameter] = {}
        self.send(mavlink.MAVLink_param_request_list_message(*self.target))
        cursor = self.asked

        def is_complete() -> bool:
            nonlocal cursor
            values = self.values_since(cursor)
            cursor = self.mark
            seen.update({p.index: p for p in values if p.index != UNLISTED_INDEX})
            return bool(seen) and len(seen) == next(iter(seen.values())).count

        if not self.run_until(is_complete, LIST_S):
            raise Violation(f"{len(seen)} parameters within {LIST_S:g} s, incomplete")
        return [seen[index] for index in sorted(seen)]


STEP_TIMEOUT_S = 4.0

REQUESTS = (mav.ItemRequest, mav.ItemIntRequest)


@dataclass(frozen=True, slots=True)
class MissionItem:
    """One MISSION_ITEM_INT without its addresses."""

    command: int
    frame: int = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
    params: tuple[float, float, float, float] = (0.0, 0.0, 0.0, mav.NAN)
    x: int = 0
    y: int = 0
    z: float = 0.0
    current: int = 0
    autocontinue: int = 1

    @property
    def lasting_fields(self) -> tuple[int, int, int, float]:
        """Fields that must survive a round trip on either flavour."""
        return (self.command, self.x, self.y, round(self.z, 3))


def waypoint(lat_e7: int, lon_e7: int, height_m: float) -> MissionItem:
    """Return NAV_WAYPOINT at a height above home."""
    return MissionItem(mavlink.MAV_CMD_NAV_WAYPOINT, x=lat_e7, y=lon_e7, z=height_m)


class PlanClient(ParameterClient):
    """Uploads, downloads and clears plans. ArduPilot's item 0 is home and no part of a mission."""

    def _remember_plan(self, kind: int) -> None:
        plans = self.baseline.plans
        if kind in (mav.MISSION, mav.FENCE, mav.RALLY) and kind not in plans:
            plans[kind] = None
            with suppress(Violation):
                plans[kind] = self.download(kind)

    def send_count(self, count: int, kind: int = mav.MISSION) -> None:
        """Send MISSION_COUNT."""
        self._remember_plan(kind)
        self.send(mav.Count(*self.target, count, kind))

    def next_step(self) -> mav.ItemRequest | mav.ItemIntRequest | mav.PlanAck:
        """Return the vehicle's next request or ACK."""
        kinds = (*REQUESTS, mav.PlanAck)
        what = "request or MISSION_ACK"
        step = self.expect(kinds, mark=self.asked, within_s=STEP_TIMEOUT_S, what=what)
        assert isinstance(step, kinds)
        return step

    def await_request(self, sequence: int) -> mav.ItemRequest | mav.ItemIntRequest:
        """Return the next request of an item, with either message."""
        step = self.next_step()
        if isinstance(step, mav.PlanAck):
            raise Violation(f"ACK {step.type} instead of a request")
        require(sequence == step.seq, f"item {step.seq} requested, not {sequence}")
        return step

    def await_ack(self) -> int:
        """Return the type of the next MISSION_ACK for us."""
        ids = (0, self.system_id)
        ack = self.expect(
            mav.PlanAck, lambda m: m.target_system in ids, mark=self.asked, within_s=STEP_TIMEOUT_S
        )
        return int(ack.type)

    def ack_of(self, message: Message) -> int:
        """Send a message; return the type of the MISSION_ACK that follows."""
        self.send(message)
        return self.await_ack()

    def send_item(self, item: MissionItem, sequence: int, kind: int = mav.MISSION) -> None:
        """Send one item of an upload."""
        head = (sequence, item.frame, item.command, item.current, item.autocontinue)
        self.send(mav.Item(*self.target, *head, *item.params, item.x, item.y, item.z, kind))

    def begin_upload(self, count: int) -> None:
        """Send MISSION_COUNT, and wait for the request of the first item."""
        self.send_count(count)
        self.await_request(0)

    def upload(self, items: Sequence[MissionItem], kind: int = mav.MISSION) -> int:
        """Upload a plan; return the type of its MISSION_ACK."""
        self.send_count(len(items), kind)
        for _ in range(20 * len(items) + 20):
            step = self.next_step()
            if isinstance(step, mav.PlanAck):
                return int(step.type)
            require(step.seq < len(items), f"item {step.seq} of {len(items)} requested")
            self.send_item(items[step.seq], step.seq, kind)
        raise Violation("the upload does not end")

    def require_upload(self, items: Sequence[MissionItem], kind: int = mav.MISSION) -> None:
        """Upload a plan, which must be accepted."""
        result = self.upload(items, kind)
        require(result == 0, f"an upload of {len(items)} items of type {kind} gave ACK {result}")

    def begin_download(self, kind: int = mav.MISSION) -> int:
        """Send MISSION_REQUEST_LIST; return the number of items."""
        answer = self.ask(
            mav.PlanRequest(*self.target, kind),
            mav.Count,
            lambda m: m.mission_type == kind,
            within_s=STEP_TIMEOUT_S,
        )
        return int(answer.count)

    def request_item(self, sequence: int, kind: int = mav.MISSION) -> MissionItem:
        """Send MISSION_REQUEST_INT; return the item."""
        m = self.ask(
            mav.ItemIntRequest(*self.target, sequence, kind),
            mav.Item,
            lambda m: m.seq == sequence and m.mission_type == kind,
            within_s=STEP_TIMEOUT_S,
        )
        params = (m.param1, m.param2, m.param3, m.param4)
        return MissionItem(m.command, m.frame, params, m.x, m.y, m.z, m.current, m.autocontinue)

    def finish_download(self, kind: int = mav.MISSION) -> None:
        """Send the client's ACK."""
        self.send(mav.PlanAck(*self.target, 0, kind))

    def download(self, kind: int = mav.MISSION) -> list[MissionItem]:
        """Download a plan, with the client's ACK at its end."""
        items = [self.request_item(sequence, kind) for sequence in range(self.begin_download(kind))]
        self.finish_download(kind)
        return items

    def clear(self, kind: int = mav.MISSION) -> int:
        """Send MISSION_CLEAR_ALL; return the type of its ACK."""
        self._remember_plan(kind)
        return self.ack_of(mav.Clear(*self.target, kind))

    def with_home(self, items: Sequence[MissionItem]) -> list[MissionItem]:
        """Return a mission as the flavour numbers it: ArduPilot's item 0 is home."""
        home = MissionItem(mavlink.MAV_CMD_NAV_WAYPOINT, mavlink.MAV_FRAME_GLOBAL, (0.0,) * 4)
        return list(items) if self.is_px4 else [home, *items]

    def without_home(self, items: Sequence[MissionItem]) -> list[MissionItem]:
        """Return a downloaded mission without ArduPilot's item 0."""
        return list(items if self.is_px4 else items[1:])

    def square(self, count: int = 4, height_m: float = 10.0) -> list[MissionItem]:
        """Return waypoints around home, 20 m apart; ArduPilot's home item first."""
        home = self.home()
        offsets = [(1_800, 0), (1_800, 2_600), (0, 2_600), (0, 0)]
        items = []
        for number in range(count):
            north, east = offsets[number % 4]
            items.append(waypoint(home.latitude + north, home.longitude + east, height_m + number))
        return self.with_home(items)

    def waypoint_home(self) -> MissionItem:
        """Return a waypoint over home."""
        home = self.home()
        return waypoint(home.latitude, home.longitude, 10.0)

    def stored(self) -> list[MissionItem]:
        """Return the mission that the vehicle has, without ArduPilot's home item."""
        return self.without_home(self.download())

    def require_stored(self, wanted: Sequence[MissionItem]) -> None:
        """Require that the vehicle has this mission, ArduPilot's home item aside."""
        found = [item.lasting_fields for item in self.stored()]
        expected = [item.lasting_fields for item in wanted]
        require(found == expected, f"the mission is {found}, not {expected}")

    def prepare(self, count: int = 3) -> list[MissionItem]:
        """Upload a mission; return its items without home."""
        items = self.square(count)
        self.require_upload(items)
        return self.without_home(items)

    def circle(self, radius_m: float = 500.0) -> list[MissionItem]:
        """Return a circular inclusion fence around home."""
        home, command = self.home(), mavlink.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION
        params = (radius_m, 0.0, 0.0, 0.0)
        return [MissionItem(command, self._fence_frame, params, home.latitude, home.longitude)]

    def polygon(self, stated: float = 4.0, half: int = 30_000) -> list[MissionItem]:
        """Return a square inclusion fence around home, each vertex stating `stated` vertices."""
        home, command = self.home(), mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION
        params = (stated, 0.0, 0.0, 0.0)
        corners = ((-half, -half), (half, -half), (half, half), (-half, half))
        positions = [(home.latitude + north, home.longitude + east) for north, east in corners]
        return [
            MissionItem(command, self._fence_frame, params, *position) for position in positions
        ]

    @property
    def _fence_frame(self) -> int:
        """Return the frame in which the flavour's clients send a fence."""
        return mavlink.MAV_FRAME_GLOBAL_INT if self.is_px4 else mavlink.MAV_FRAME_GLOBAL

    def rally(self) -> list[MissionItem]:
        """Return one rally point near home."""
        home, command = self.home(), mavlink.MAV_CMD_NAV_RALLY_POINT
        frame = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
        if not self.is_px4:
            frame = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT
        position = (home.latitude + 900, home.longitude, 15.0)
        return [MissionItem(command, frame, (0.0, 0.0, 0.0, 0.0), *position)]

    def enable_fence(self) -> None:
        """Activate the fence (PX4: hold at it); `NotApplicable`: not possible."""
        name, value = ("GF_ACTION", 2.0) if self.is_px4 else ("FENCE_ENABLE", 1.0)
        try:
            self.change(name, value)
        except Violation:
            raise NotApplicable(f"no parameter {name}") from None


STREAM_PERIOD_S = 0.1
Setpoint = LocalSetpoint | GlobalSetpoint


class SetpointClient(VehicleProbe):
    """Client that lets a vehicle follow setpoints."""

    def send_setpoint(self, setpoint: Setpoint) -> None:
        """Send one setpoint, once."""
        self.send(setpoint.message(self.target))

    def stream(
        self,
        setpoint: Setpoint,
        target: tuple[int, int] | None = None,
        period_s: float = STREAM_PERIOD_S,
    ) -> Callable[[], None]:
        """Send a setpoint, to the vehicle or another target, until the result is called."""
        message = setpoint.message(target or self.target)
        return self.repeat(lambda: message, period_s)

    def enter_offboard(self, setpoint: Setpoint) -> Callable[[], None]:
        """Let the vehicle follow a streamed setpoint in the air; return a handle that ends it."""
        stop = self.stream(setpoint)
        self.run(1.2)
        self.require_mode("offboard")
        self.await_mode("offboard")
        return stop

    def begin_streaming(self) -> Callable[[], None]:
        """Take off and follow a streamed setpoint here; return the end of the stream."""
        self.take_off()
        stop = self.enter_offboard(LocalSetpoint(self.position()))
        self.run(1.0)
        return stop

    def begin(self) -> Triple:
        """Take off and follow setpoints, which then end; return the vehicle position."""
        self.begin_streaming()()
        return self.position()

    def fly(
        self, setpoint: Setpoint, duration_s: float, target: tuple[int, int] | None = None
    ) -> None:
        """Stream one setpoint for a while, to the vehicle or to another target."""
        stop = self.stream(setpoint, target)
        self.run(duration_s)
        stop()

    def follow(self, setpoint: Setpoint, duration_s: float) -> None:
        """Stream one setpoint for a while, and until HEARTBEAT shows that it is followed."""
        stop = self.stream(setpoint)
        self.run(duration_s)
        self.await_mode("offboard", 3.0)
        stop()

    def measure_speed(self, setpoint: Setpoint) -> Triple:
        """Stream one setpoint for 4 s; return the velocity before the stream ends."""
        stop = self.stream(setpoint)
        self.run(4.0)
        speed = self.speed()
        stop()
        return speed

    def require_position(self, wanted: Triple, what: str) -> None:
        """Require that the vehicle is at a position, to half a metre and the wind's effect."""
        off_m = math.dist(self.position(), wanted)
        require(off_m < 1.0, f"{what}: {off_m:.1f} m off")
