"""The operator's telemetry: what a vehicle's frames say, whoever made it."""

from __future__ import annotations

import math

from companion.domain import PositionEnu
from companion.geometry.coordinates import LocalOrigin
from companion.guidance.events import (
    HeartbeatReceived,
    HomeSet,
    LandedStateChanged,
    OriginSet,
    VehicleMoved,
)
from companion.link.inbound import VehicleInbound
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.flight_modes import autopilot_of
from sim_link.mission.record import FlightRecord, Said
from sim_link.mission.situation import Situation

COUNTED_STEP_M = 0.2
"""Steps of the flown distance that are counted; less is the position's noise."""
TRACK_PERIOD_S = 0.2
GPS_FIX_3D = 3
UNKNOWN_BATTERY = -1


class TelemetryReader:
    """Turns the vehicle's frames into the situation and the record of the flight.

    Args:
        record: Grows.
        situation: Is kept up to date.
    """

    def __init__(self, record: FlightRecord, situation: Situation) -> None:
        self._record = record
        self._situation = situation
        self._codec = MavCodec(0, 0)
        self._inbound = VehicleInbound()
        self._texts: dict[int, str] = {}
        self._home_enu_m: PositionEnu | None = None
        self._counted_at: PositionEnu | None = None
        self._track_due_s = 0.0
        self.origin: LocalOrigin | None = None
        """Zero of the local frame."""
        self.system_id: int | None = None
        """Of the autopilot that was heard first."""
        self.heartbeat: HeartbeatReceived | None = None
        """The newest one of the autopilot."""

    def take(self, frame: bytes, now_s: float) -> None:
        """Take in a frame from the vehicle's link."""
        message = self._codec.decode_frame(frame)
        if message is None or not self._is_ours(message):
            return
        self._record.messages["autopilot", message.get_msgId()] += 1
        self._take_plain(message, now_s)
        for event in self._inbound.events(message, now_s):
            match event:
                case HeartbeatReceived():
                    self.heartbeat = event
                    seen = self._situation.vehicle
                    seen.mode, seen.is_armed = event.mode.value, event.is_armed
                    seen.is_failsafe = event.is_failsafe
                case VehicleMoved():
                    self._move(event, now_s)
                case HomeSet():
                    self._home_enu_m = event.position_enu_m
                case OriginSet():
                    self.origin = event.origin
                case LandedStateChanged():
                    self._situation.vehicle.landed = event.landed.name.lower()

    def take_companion(self, frame: bytes) -> None:
        """Count a frame that the companion sent."""
        message = self._codec.decode_frame(frame)
        if message is not None:
            self._record.messages["companion", message.get_msgId()] += 1

    def _is_ours(self, message: Message) -> bool:
        """Whether the sender is on the vehicle that was heard first; its radio is, too."""
        if self.system_id is None and _is_autopilots(message):
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

    def _hear(self, message: mavlink.MAVLink_statustext_message, now_s: float) -> None:
        """A text of the autopilot; one that comes in pieces counts when it is whole."""
        if message.get_srcComponent() != mavlink.MAV_COMP_ID_AUTOPILOT1:
            return
        text, number = str(message.text), message.id
        if number:
            text = self._texts.get(number, "") + text
            if len(str(message.text)) == 50:
                self._texts[number] = text
                return
            self._texts.pop(number, None)
        self._record.texts.append(Said(now_s, "autopilot", text))
        self._situation.autopilot_texts.append(text)

    def _move(self, event: VehicleMoved, now_s: float) -> None:
        state, seen = event.state, self._situation.vehicle
        place, velocity = state.position_enu_m, state.velocity_enu_mps
        if not all(math.isfinite(value) for value in (*place, *velocity)):
            return
        seen.east_m, seen.north_m = place[:2]
        seen.speed_mps, seen.climb_mps = math.hypot(*velocity[:2]), velocity[2]
        home = self._home_enu_m
        if home is not None:
            seen.height_m = place[2] - home[2]
            seen.home_distance_m = math.dist(place[:2], home[:2])
        self._count(place)
        seen.distance_m = self._record.distance_m
        if now_s >= self._track_due_s:
            self._track_due_s = now_s + TRACK_PERIOD_S
            self._record.track.append((now_s, place))

    def _count(self, place: PositionEnu) -> None:
        if self._counted_at is None or not self._situation.vehicle.is_armed:
            self._counted_at = place
            return
        step_m = math.dist(place, self._counted_at)
        if step_m >= COUNTED_STEP_M:
            self._record.distance_m += step_m
            self._counted_at = place


def _is_autopilots(message: Message) -> bool:
    """Whether it is an autopilot's HEARTBEAT."""
    if not isinstance(message, mavlink.MAVLink_heartbeat_message):
        return False
    return autopilot_of(message) is not None
