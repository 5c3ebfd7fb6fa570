"""Readers of a flight: the vehicle's telemetry, the companion's event log, recorded frames."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from companion.config.schema import CompanionConfig
from companion.domain import PositionEnu
from companion.geometry.coordinates import LocalOrigin
from companion.geometry.polygons import Point
from companion.guidance import events
from companion.guidance.commands import ReportResult, Severity
from companion.guidance.phases import IN_CONTROL
from companion.link.inbound import VehicleInbound
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.flight_modes import autopilot_of
from companion.report.flight_summary import EstimatePoint
from sim_link.lab.mission.processes import PERIOD_S
from sim_link.lab.mission.results import FlightRecord, OperatorText, Report
from sim_link.lab.monitor.monitor import WIRE
from sim_link.lab.monitor.scene import Rules
from sim_link.lab.monitor.wire_monitor import Recording, WireMonitor

COUNTED_STEP_M = 0.2
"""Steps of the flown distance that are counted; less is the position's noise."""
TRACK_PERIOD_S = 0.2
GPS_FIX_3D = 3
UNKNOWN_BATTERY = -1


def rules_of(config: CompanionConfig) -> Rules:
    """Derive the monitor's rules from a configuration."""
    limits = msgspec.structs.asdict(config.limits)
    shared = {name: limits[name] for name in Rules.__struct_fields__ if name in limits}
    return Rules(
        system_id=config.vehicle.system_id,
        keeps_autopilot_fence=config.limits.autopilot_fence != "ignore",
        **shared,
    )


class TelemetryReader:
    """Updates the situation and the record of the flight from the vehicle's frames."""

    def __init__(self, record: FlightRecord) -> None:
        self._record = record
        self._situation = record.situation
        self._codec = MavCodec(0, 0)
        self._inbound = VehicleInbound()
        self._texts: dict[int, str] = {}
        self._home_enu_m: PositionEnu | None = None
        self._counted_at: PositionEnu | None = None
        self._track_due_s = 0.0
        self.origin: LocalOrigin | None = None
        self.system_id: int | None = None
        """System id of the autopilot that was heard first."""
        self.heartbeat: events.HeartbeatReceived | None = None
        self.throttle_us = 0
        """Channel 3 of the pilot's transmitter; 0: none is heard."""

    def take(self, frame: bytes, now_s: float) -> None:
        """Process a frame from the vehicle's link."""
        message = self._codec.decode_frame(frame)
        if message is None or not self._is_ours(message):
            return
        self._record.messages["autopilot", message.get_msgId()] += 1
        self._take_plain(message, now_s)
        for event in self._inbound.events(message, now_s):
            match event:
                case events.HeartbeatReceived():
                    self.heartbeat = event
                    seen = self._situation.vehicle
                    seen.mode, seen.is_armed = event.mode.value, event.is_armed
                    seen.is_failsafe = event.is_failsafe
                case events.VehicleMoved():
                    self._move(event, now_s)
                case events.HomeSet():
                    self._home_enu_m = event.position_enu_m
                case events.OriginSet():
                    self.origin = event.origin
                case events.LandedStateChanged():
                    self._situation.vehicle.landed = event.landed.name.lower()

    def take_companion(self, frame: bytes) -> None:
        """Count a frame that the companion sent."""
        message = self._codec.decode_frame(frame)
        if message is not None:
            self._record.messages["companion", message.get_msgId()] += 1

    def _is_ours(self, message: Message) -> bool:
        """Return True if the sender is on the vehicle that was heard first; its radio is, too."""
        match message:
            case mavlink.MAVLink_heartbeat_message() if self.system_id is None:
                if autopilot_of(message) is not None:
                    self.system_id = message.get_srcSystem()
        return message.get_srcSystem() == self.system_id

    def _take_plain(self, message: Message, now_s: float) -> None:
        vehicle = self._situation.vehicle
        match message:
            case mavlink.MAVLink_statustext_message():
                self._hear(message, now_s)
            case mavlink.MAVLink_sys_status_message():
                known = message.battery_remaining != UNKNOWN_BATTERY
                vehicle.battery = message.battery_remaining / 100.0 if known else None
            case mavlink.MAVLink_gps_raw_int_message():
                vehicle.has_fix = message.fix_type >= GPS_FIX_3D
            case mavlink.MAVLink_rc_channels_message() if message.chancount:
                self.throttle_us = message.chan3_raw

    def _hear(self, message: mavlink.MAVLink_statustext_message, now_s: float) -> None:
        """Handle a text of the autopilot, once all of its chunks have arrived."""
        if message.get_srcComponent() != mavlink.MAV_COMP_ID_AUTOPILOT1:
            return
        text, number = str(message.text), message.id
        if number:
            text = self._texts.get(number, "") + text
            if len(str(message.text)) == 50:
                self._texts[number] = text
                return
            self._texts.pop(number, None)
        self._record.texts.append(OperatorText(now_s, "autopilot", text))
        self._situation.autopilot_texts.append(text)

    def _move(self, event: events.VehicleMoved, now_s: float) -> None:
        state, seen = event.state, self._situation.vehicle
        position, velocity = state.position_enu_m, state.velocity_enu_mps
        if not all(math.isfinite(value) for value in (*position, *velocity)):
            return
        seen.east_m, seen.north_m = position[:2]
        seen.speed_mps, seen.climb_mps = math.hypot(*velocity[:2]), velocity[2]
        home = self._home_enu_m
        if home is not None:
            seen.height_m = position[2] - home[2]
            seen.home_distance_m = math.dist(position[:2], home[:2])
        self._count(position)
        seen.distance_m = self._record.distance_m
        if now_s >= self._track_due_s:
            self._track_due_s = now_s + TRACK_PERIOD_S
            self._record.track.append((now_s, position))

    def _count(self, position: PositionEnu) -> None:
        if self._counted_at is None or not self._situation.vehicle.is_armed:
            self._counted_at = position
            return
        step_m = math.dist(position, self._counted_at)
        if step_m >= COUNTED_STEP_M:
            self._record.distance_m += step_m
            self._counted_at = position


CONTROL_PHASES = frozenset(phase.value for phase in IN_CONTROL)


class EventReader:
    """Updates the situation and the record of the flight from events of the companion.

    It is a companion's `Journal`, so that a companion in memory writes straight into it. An event
    that names no emitter is about the first one.
    """

    def __init__(
        self, record: FlightRecord, emitters: Mapping[int, Point], first_emitter: int
    ) -> None:
        self._record = record
        self._situation = record.situation
        self._emitters = emitters
        self._first_emitter = first_emitter
        self._ranging_heard_s: float | None = None

    def frame(self, data: bytes, now_s: float) -> None:
        """Do nothing: frames are watched on the wire."""

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        """Handle a text for the operator."""
        self.record("text", {"severity": severity.name.lower(), "text": text}, now_s)

    def result(self, report: ReportResult, now_s: float) -> None:
        """Handle a target that was found."""
        estimate = report.estimate
        east_m, north_m = estimate.position_enu_m
        fields = {
            "emitter_id": report.emitter_id,
            "east_m": east_m,
            "north_m": north_m,
            "r95_m": estimate.r95_m,
        }
        self.record("result", fields, now_s)

    def record(self, kind: str, fields: Mapping[str, Any], now_s: float) -> None:
        """Process an event at a time since the mission began."""
        self._record.events.append((now_s, kind, fields))
        match kind:
            case "estimate":
                self._take_estimate(fields, now_s)
            case "refused":
                self._situation.companion.refused += int(fields["count"])
            case "phase":
                self._enter(fields["new"], now_s)
            case "bound" if self._situation.companion.phase is None:
                self._enter("waiting", now_s)
            case "text":
                self._record.texts.append(OperatorText(now_s, "companion", fields["text"]))
                self._situation.companion_texts.append(fields["text"])
            case "waypoint":
                self._situation.companion.waypoint = fields["reason"]
                position = _point(fields["position_enu_m"])
                self._record.waypoints.append((now_s, position, fields["reason"]))
            case "result":
                emitter = fields.get("emitter_id")
                if emitter is None:
                    emitter = self._situation.estimate.emitter
                position = (float(fields["east_m"]), float(fields["north_m"]))
                self._record.reports.append(Report(now_s, emitter, position, fields["r95_m"]))
                self._situation.companion.reported += 1

    def age(self, now_s: float) -> None:
        """Increase all ages."""
        if self._ranging_heard_s is not None:
            self._situation.companion.ranging_age_s = now_s - self._ranging_heard_s

    def restarted(self) -> None:
        """Handle the end of the companion's process, which voids its own reports."""
        companion = self._situation.companion
        companion.phase = companion.is_in_control = companion.waypoint = None

    def _enter(self, phase: str, time_s: float) -> None:
        companion = self._situation.companion
        companion.phase = phase
        companion.is_in_control = phase in CONTROL_PHASES
        if companion.is_in_control and self._record.engaged_s is None:
            self._record.engaged_s = time_s

    def _take_estimate(self, fields: Mapping[str, Any], time_s: float) -> None:
        self._ranging_heard_s = time_s
        self._situation.companion.measurements += 1
        emitter = fields.get("emitter_id", self._first_emitter)
        position = _point(fields["position_enu_m"])
        point = EstimatePoint(
            time_s=time_s,
            position_enu_m=position,
            r95_m=fields["r95_m"],
            state=fields["state"],
            range_innovation_m=fields.get("range_innovation"),
            covariance_m2=fields.get("covariance_m2"),
            emitter_id=emitter,
            absolute_r95_m=fields.get("absolute_r95_m"),
        )
        self._record.estimates.append(point)
        seen, truth = self._situation.estimate, self._emitters.get(emitter)
        seen.emitter, seen.state, seen.r95_m = emitter, point.state, point.r95_m
        seen.east_m, seen.north_m = position
        seen.error_m = None if truth is None else math.dist(position, truth)
        seen.range_offset_m = fields["range_offset_m"]
        seen.bearing_offset_deg = math.degrees(fields["bearing_offset_rad"])


def _point(value: Any) -> Point:
    east, north = value
    return (float(east), float(north))


MACHINE_S = 0.25
"""Scheduling delay of a process, real time, that has no effect."""


class WireWatch:
    """Records the hub's traffic at a speed in seconds of the flight per second."""

    def __init__(self, speed: float) -> None:
        self.recording = Recording()
        """Recording that also observes the companion's process."""
        self._machine_s = MACHINE_S * speed
        self._late_s = 0.0
        self._looked_s: float | None = None
        self._events: list[tuple[float, str, Mapping[str, Any]]] = []
        """Events of the companion's current process, with its own times."""

    @property
    def slack_s(self) -> float:
        """Return the time in s of flight by which frames may be late: the hub itself was, too."""
        return self._machine_s + self._late_s

    def looked(self, now_s: float) -> None:
        """Record the hub's lateness, which shows how busy the machine is."""
        if self._looked_s is not None:
            self._late_s = max(self._late_s, now_s - self._looked_s - PERIOD_S)
        self._looked_s = now_s

    def noted(self, kind: str, fields: Mapping[str, Any], companion_s: float) -> None:
        """Handle a log entry of the companion, at its own time."""
        self._events.append((companion_s, kind, fields))

    def date_events(self, offset_s: float | None) -> None:
        """Date a complete log; the offset is the mission's time minus the companion's."""
        if offset_s is not None:
            for time_s, kind, fields in self._events:
                self.recording.noted(kind, fields, time_s + offset_s)
        self._events.clear()

    def judge(self, config: CompanionConfig, record: FlightRecord) -> None:
        """Write findings and verdicts to the record."""
        monitor = WireMonitor(rules_of(config), self.slack_s)
        self.recording.play(monitor)
        record.scope, record.slack_s, record.late_s = WIRE, self.slack_s, self._late_s
        record.violations += monitor.violations


LOGS = "*/events.jsonl"


class EventTail:
    """Follows the companion's event log in a flight folder below `root`."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._seen = set(root.glob(LOGS))
        """Logs of an earlier mission, and those already read."""
        self._path: Path | None = None
        self._offset = 0
        self._rest = b""

    def look_for_flight(self) -> bool:
        """Return True if a new flight began since the last call; its log is read from now on."""
        for path in sorted(self._root.glob(LOGS)):
            if path not in self._seen:
                self._seen.add(path)
                self._path, self._offset, self._rest = path, 0, b""
                return True
        return False

    def take(self) -> list[dict[str, Any]]:
        """Return the events since the last call; a line that is not whole yet waits."""
        if self._path is None:
            return []
        with self._path.open("rb") as file:
            file.seek(self._offset)
            data = file.read()
        self._offset += len(data)
        *lines, self._rest = (self._rest + data).split(b"\n")
        return [json.loads(line) for line in lines if line]
