"""Monitor of real processes, which plays back and judges recorded frames.

Theory of operation. The vehicle's own reports stand for its state, and only invariants that need no
more are judged (see `monitor.WIRE`). Times are those at which frames passed the recorder; on a busy
machine they are late by the scheduling delay. Time limits are wider by it,
and setpoints are compared by the stamps that the companion gave them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgspec

from companion.domain import EstimateState, FlightMode, TargetEstimate
from companion.geometry.coordinates import LocalOrigin, Projection
from companion.mav.dialect import mavlink
from sim_link.lab.monitor import authority_invariants, fence_invariants, message_invariants
from sim_link.lab.monitor.monitor import FrameMonitor
from sim_link.lab.monitor.scene import (
    AUTOPILOT_COMPONENT,
    OBSERVED_MESSAGES,
    ObservedScene,
    Rules,
    SentSetpoint,
    is_offboard,
)
from sim_link.lab.observer import Frame, Observer

WATCHED = OBSERVED_MESSAGES | {
    mavlink.MAVLINK_MSG_ID_HOME_POSITION,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,
    mavlink.MAVLINK_MSG_ID_COMMAND_LONG,
}
"""Messages to the companion that an invariant looks at; a real vehicle sends hundreds of others."""


class Recording(Observer):
    """Keeps frames, journal and the fate of the companion's process."""

    def __init__(self) -> None:
        self._seen: list[tuple[float, str, tuple[Any, ...]]] = []

    def play(self, observer: Observer) -> None:
        """Show everything; simultaneous events in order of arrival."""
        for _, what, values in sorted(self._seen, key=lambda seen: seen[0]):
            getattr(observer, what)(*values)

    def _keep(self, time_s: float, what: str, *values: object) -> None:
        self._seen.append((time_s, what, values))

    def sent(self, frame: Frame) -> None:
        """Handle a frame that the companion sent."""
        self._keep(frame.time_s, "sent", frame)

    def heard(self, frame: Frame) -> None:
        """Handle a frame that reaches the companion."""
        if frame.number in WATCHED:
            self._keep(frame.time_s, "heard", frame)

    def vehicle_sent(self, frame: Frame) -> None:
        """Handle a frame that the vehicle sent."""
        if frame.number in WATCHED:
            self._keep(frame.time_s, "vehicle_sent", frame)

    def noted(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Handle a journal entry of the companion."""
        self._keep(now_s, "noted", kind, fields, now_s)

    def companion_started(self, now_s: float) -> None:
        """Handle a restart of the companion process."""
        self._keep(now_s, "companion_started", now_s)

    def companion_suspended(self, now_s: float, until_s: float) -> None:
        """Handle a suspension of the companion process."""
        self._keep(now_s, "companion_suspended", now_s, until_s)

    def companion_ended(self, now_s: float) -> None:
        """Handle the end of the companion process."""
        self._keep(now_s, "companion_ended", now_s)


STALLED = "control loop stalled"
"""Beginning of the text after a stall: the companion is silent until it knows the mode."""


TIMES = ("answer_s", "gap_s", "state_age_s", "latency_s")
RATES = ("sent_frames_per_s", "sent_bytes_per_s", "records_per_s")


@dataclass(slots=True)
class HeardScene(ObservedScene):
    """Scene in which the vehicle's own reports are the truth."""

    _is_armed: bool = False
    _is_in_air: bool = False
    _home: mavlink.MAVLink_home_position_message | None = None
    stamps_from_s: float | None = None
    """Recorder's time minus that of the setpoints' stamps."""

    def remember(self, frame: Frame) -> None:
        """Handle a frame that the vehicle sent."""
        super(HeardScene, self).remember(frame)  # slots make another class of this one
        message = frame.message
        match message:
            case mavlink.MAVLink_heartbeat_message():
                is_invalid = message.autopilot == mavlink.MAV_AUTOPILOT_INVALID
                if frame.sender[1] != AUTOPILOT_COMPONENT or is_invalid:
                    return  # a payload's or a station's
                if self.system_id is None:
                    self.system_id = frame.sender[0]
                    self.is_px4 = message.autopilot == mavlink.MAV_AUTOPILOT_PX4
                self._is_armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            case mavlink.MAVLink_extended_sys_state_message():
                self._is_in_air = message.landed_state != mavlink.MAV_LANDED_STATE_ON_GROUND
        self.is_flying = self._is_armed or self._is_in_air

    def observe(self, frame: Frame) -> None:
        """Take a frame that the companion had to accept."""
        if self.is_of_autopilot(frame):
            message = frame.message
            match message:
                case mavlink.MAVLink_gps_global_origin_message() if self.world_origin is None:
                    self.world_origin = LocalOrigin(
                        message.latitude / 1e7,
                        message.longitude / 1e7,
                        message.altitude / 1e3,
                        Projection.SPHERE if self.is_px4 else Projection.FLAT,
                    )
                case mavlink.MAVLink_home_position_message():
                    self._home = message
            home, world = self._home, self.world_origin
            if home is not None and world is not None:
                position = (home.latitude / 1e7, home.longitude / 1e7, home.altitude / 1e3)
                self.home_up_m = world.enu_from_geodetic(*position)[2]
        super(HeardScene, self).observe(frame)

    def setpoint_of(self, frame: Frame) -> SentSetpoint | None:
        """Return the setpoint in a frame of the companion at its stamp; None: no setpoint."""
        setpoint = super(HeardScene, self).setpoint_of(frame)
        if setpoint is None:
            return None
        stamp_s = getattr(setpoint.message, "time_boot_ms", 0) / 1e3
        if self.stamps_from_s is None:
            self.stamps_from_s = setpoint.time_s - stamp_s
        setpoint.time_s = self.stamps_from_s + stamp_s
        return setpoint


class WireMonitor(FrameMonitor):
    """Watches a flight by its recording, in which a frame may be late by some slack."""

    def __init__(self, rules: Rules, slack_s: float) -> None:
        late = {name: getattr(rules, name) + slack_s for name in TIMES}
        more = {name: getattr(rules, name) * (1.0 + slack_s) for name in RATES}
        self.scene = scene = HeardScene(msgspec.structs.replace(rules, **late, **more))
        self._estimate: TargetEstimate | None = None
        self._is_offboard: bool | None = None
        self._stream = authority_invariants.KeepsStreaming(scene)
        self._covariance = message_invariants.HonestCovariance(scene, lambda: self._estimate)
        invariants = [
            fence_invariants.SetpointsInside(scene),
            message_invariants.WithinEnvelope(scene),
            authority_invariants.OnlyWithAuthority(scene),
            fence_invariants.PositionsOnly(scene),
            message_invariants.FreshState(scene),
            message_invariants.KnownFrames(scene),
            self._stream,
            self._covariance,
            message_invariants.Bounded(scene),
            authority_invariants.FewTexts(scene),
        ]
        super().__init__(scene, invariants)

    def vehicle_sent(self, frame: Frame) -> None:
        """Handle a frame of the vehicle; a changed mode counts as set by an authorised person."""
        super().vehicle_sent(frame)
        message = frame.message
        if not isinstance(message, mavlink.MAVLink_heartbeat_message):
            return
        if not self.scene.is_of_autopilot(frame):
            return
        now, before = is_offboard(message), self._is_offboard
        self._is_offboard = now
        if now != before:
            self.mode_chosen(FlightMode.OFFBOARD if now else FlightMode.UNKNOWN, frame.time_s)

    def heard(self, frame: Frame) -> None:
        """Handle a frame that reaches the companion at a later time."""
        super().heard(frame)
        self._stream.stepped()

    def noted(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Handle a log entry of the companion."""
        super().noted(kind, fields, now_s)
        if kind == "text" and str(fields["text"]).startswith(STALLED):
            self.companion_suspended(now_s, now_s)
        if kind == "estimate":
            self._estimate = _estimate_from(fields, now_s)
            self._covariance.ticked()

    def companion_started(self, now_s: float) -> None:
        """Handle a restart of the companion process."""
        self.scene.stamps_from_s = None  # another process stamps by another clock
        super().companion_started(now_s)


def _estimate_from(fields: Mapping[str, Any], now_s: float) -> TargetEstimate:
    """Return the parts for judging the covariance; a log has null for NaN."""
    a, b, c, d = (_number(each) for row in fields["covariance_m2"] for each in row)
    east_m, north_m = map(_number, fields["position_enu_m"])
    return TargetEstimate(
        time_s=now_s,
        state=EstimateState(fields["state"]),
        position_enu_m=(east_m, north_m),
        covariance_m2=((a, b), (c, d)),
        r95_m=_number(fields["r95_m"]),
        range_offset_m=0.0,
        bearing_offset_rad=0.0,
        measurements=0,
    )


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
