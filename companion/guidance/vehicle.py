"""State of the vehicle in the session: mode, position, origin, home and health.

Theory of operation of the mode watch. A HEARTBEAT carries no time, and frames held back by a link
or a socket arrive oldest first. After a stall of the control tick, or a long silence, the mode is
unconfirmed: a pilot may be flying. A HEARTBEAT confirms it if the autopilot sent it after a message
with a current time stamp, a position or an attitude. Until then no setpoint is sent, no mode counts
as selected, and nothing is requested of the autopilot; but a vehicle that reports for seconds that
it still follows our setpoints, while stamped messages are missing, may be asked to fly by itself.
"""

from __future__ import annotations

import math
from collections import deque

from companion.domain import (
    ARDUPILOT_NAMES,
    Attitude,
    Autopilot,
    FlightMode,
    LandedState,
    PositionEnu,
    VehicleClass,
)
from companion.geometry.coordinates import LocalOrigin
from companion.guard.gate import Motion
from companion.guidance import events
from companion.guidance.vehicle_track import PositionAccuracyWatch, VehicleTrack, is_plausible


def mode_name(mode: FlightMode, autopilot: Autopilot, other: str = "") -> str:
    """Return the mode as the autopilot's own tools call it; `other` replaces an unknown name."""
    name: str = mode.value
    if other or mode is FlightMode.UNKNOWN:
        return other or "another mode"
    return ARDUPILOT_NAMES.get(mode, name) if autopilot is Autopilot.ARDUPILOT else name


def mode_text(heartbeat: events.HeartbeatReceived) -> str:
    """Return the mode of a HEARTBEAT as the autopilot's own tools call it."""
    return mode_name(heartbeat.mode, heartbeat.autopilot, heartbeat.other_mode)


def vehicle_refusal(vehicle_class: VehicleClass, autopilot: Autopilot) -> str | None:
    """Return the reason why this class or autopilot is not supported; None if it is."""
    if not vehicle_class.is_flown:
        name = vehicle_class.value
        article = "an" if name[0] in "aeiou" else "a"
        return f"only multicopters are supported: this is {article} {name}"
    if autopilot is Autopilot.OTHER:
        return "only PX4 and ArduPilot are supported: this is another autopilot"
    return None


MODE_UNKNOWN_AFTER_S = 10.0
"""Time without a HEARTBEAT after which control is unknown: stop, so that its failsafe acts."""
MAX_MODE_AGE_S = 1.0
"""Age above which a reported mode is out of date."""
DOUBT_TIMEOUT_S = 5.0
"""Time after which another mode may be requested of a vehicle that still reports ours."""
MAX_STAMPED = 256
"""Two seconds of a busy link."""
LATE_S = 3.0
"""Silence in s after which a HEARTBEAT, sent every second, is missing."""


class ModeWatch:
    """Follows the reported mode, and whether it is current."""

    def __init__(self) -> None:
        self.is_in_doubt = False
        self._since_s = -math.inf
        self._reported: events.HeartbeatReceived | None = None
        self._stamped: deque[tuple[float, int | None]] = deque(maxlen=MAX_STAMPED)
        """Time, and position in the sender's sequence, of the last stamped messages."""

    def note_stamp(self, measured_at_s: float, order: int | None) -> None:
        """Record a message that carries the time at which it was sent."""
        self._stamped.append((measured_at_s, order))

    def note_heartbeat(self, heartbeat: events.HeartbeatReceived) -> None:
        """Record a HEARTBEAT; it confirms the mode if it is recent."""
        self._reported = heartbeat
        self.is_in_doubt = self.is_in_doubt and not self._is_recent(heartbeat)

    def tick(self, now_s: float) -> None:
        """Mark the mode as unconfirmed after a long silence."""
        if not self.is_in_doubt and self._is_silent(now_s):
            self.invalidate(now_s)

    def invalidate(self, now_s: float) -> None:
        """Mark the mode as unconfirmed: all messages so far are out of date."""
        self.is_in_doubt, self._since_s = True, now_s

    def forget(self) -> None:
        """Drop the mode, because the autopilot restarted."""
        self._reported = None
        self._stamped.clear()

    def is_known(self, now_s: float) -> bool:
        """Return True if the reported mode is current."""
        return self._reported is not None and not (self._is_silent(now_s) or self.is_in_doubt)

    def may_request_mode(self, now_s: float) -> bool:
        """Return True if a requested mode cannot override a pilot, to our knowledge."""
        if self.is_known(now_s):
            return True
        shown = self._reported
        if shown is None or not (shown.is_armed and shown.mode is FlightMode.OFFBOARD):
            return False
        is_heard = shown.time_s > self._since_s and now_s - shown.time_s <= LATE_S
        return is_heard and now_s - self._since_s >= DOUBT_TIMEOUT_S

    def _is_silent(self, now_s: float) -> bool:
        return self._reported is not None and now_s - self._reported.time_s > MODE_UNKNOWN_AFTER_S

    def _is_recent(self, heartbeat: events.HeartbeatReceived) -> bool:
        """Return True if a stamped message, sent no later than this one, proves it."""
        order = heartbeat.order
        return any(
            heartbeat.time_s - stamped_s <= MAX_MODE_AGE_S
            and (order is None or number is None or number <= order)
            for stamped_s, number in reversed(self._stamped)  # the newest one is the likeliest
        )


STALE_STATE_S = 0.5
"""Longest age of a vehicle position that is used for guidance."""
LINK_LOST_S = 1.0
"""Time without any valid frame of the autopilot after which the link is lost."""
LANDED_TIMEOUT_S = 3.5
"""Longest age of EXTENDED_SYS_STATE, seven of the requested periods."""
MIN_STEP_M = 0.05
"""Shorter moves are noise, not distance flown."""
MAX_HOME_DISTANCE_M = 1e5
"""Longest distance of home from the origin; a longer one is a fault of one of the two."""
ORIGIN_STEP_M = 1.0
"""Step of an origin above which the local frame has moved as well."""


class VehicleView:
    """Mode, position, origin, home and health of the vehicle, as last reported."""

    def __init__(self, *, needs_origin: bool = False) -> None:
        self.track = VehicleTrack()
        self.mode_watch = ModeWatch()
        self.position_accuracy = PositionAccuracyWatch()
        self.heartbeat: events.HeartbeatReceived | None = None
        self.origin: LocalOrigin | None = None
        self.frame: LocalOrigin | None = None
        """Origin at the last reset of the local positions; it may have crept since."""
        self.home_enu_m: PositionEnu | None = None
        """Home that altitudes refer to; its height is frozen in flight."""
        self.reported_home_enu_m: PositionEnu | None = None
        self.identity_problem: str | None = None
        """Reason why it may be another vehicle than before, or one of two; None: no doubt."""
        self.battery_pct: float | None = None
        self.landed = LandedState.UNKNOWN
        self._landed_s = -math.inf
        self.heard_s: float | None = None
        """Time of the autopilot's last frame, as of the last control tick or HEARTBEAT."""
        self.distance_m = 0.0
        """Distance flown while armed, climbs included."""
        self._counted_at: PositionEnu | None = None
        self._needs_origin = needs_origin
        self._keeps_home = False

    def handle(self, event: events.Event) -> None:
        """Apply an event about the vehicle; ignore others."""
        match event:
            case events.HeartbeatReceived():
                self.position_accuracy.handle(event)
                self.heartbeat, self.heard_s = event, event.time_s
                self.mode_watch.note_heartbeat(event)
            case events.PositionAccuracyReported():
                self.position_accuracy.handle(event)
            case events.VehicleMoved():
                self.position_accuracy.handle(event)
                self._move(event)
            case events.YawMeasured() if math.isfinite(event.yaw_ned_rad):
                attitude = Attitude(event.yaw_ned_rad, event.tilt_rad)
                self.track.add_attitude(event.measured_at_s, attitude)
                self.mode_watch.note_stamp(event.measured_at_s, event.order)
            case events.OriginSet():
                self.origin = event.origin
                self.frame = self.frame or event.origin
            case events.HomeSet() if all(math.isfinite(v) for v in event.position_enu_m):
                self._set_home(event.position_enu_m)
            case events.BatteryReported():
                self.battery_pct = event.charge_pct
            case events.LandedStateChanged():
                self.landed, self._landed_s = event.landed, event.time_s
            case events.IdentityDoubted():
                self.identity_problem = event.problem

    def forget(self) -> None:
        """Drop all state that a restart of the autopilot invalidates."""
        self.forget_frame()
        self.heartbeat = None
        self.origin = None
        self.landed = LandedState.UNKNOWN
        self.battery_pct = None
        self.mode_watch.forget()
        self.position_accuracy = PositionAccuracyWatch()

    def invalidate(self, now_s: float) -> None:
        """Wait for a new mode and position, because those received so far are out of date."""
        self.mode_watch.invalidate(now_s)
        self.track.clear()

    def forget_frame(self) -> None:
        """Drop every local position, because the frame moved."""
        self.track.clear()
        self.frame = None
        self.home_enu_m = self.reported_home_enu_m = None
        self._counted_at = None

    def shift(self, jump_enu_m: PositionEnu) -> None:
        """Shift earlier positions by a jump of the reported position."""
        self.track.shift(jump_enu_m)
        self._counted_at = None

    def keep_home(self, keeps: bool) -> None:
        """Freeze or release the height of the home that altitudes refer to."""
        self._keeps_home = keeps
        if not keeps:
            self.home_enu_m = self.reported_home_enu_m

    def _set_home(self, home_enu_m: PositionEnu) -> None:
        before, self.reported_home_enu_m = self.home_enu_m, home_enu_m
        is_kept = self._keeps_home and before is not None
        up_m = before[2] if before is not None and is_kept else home_enu_m[2]
        self.home_enu_m = (*home_enu_m[:2], up_m)

    def origin_step_m(self, origin: LocalOrigin) -> float:
        """Return the distance of an origin from the one of the local frame; 0 if none is known."""
        if self.frame is None:
            return 0.0
        return math.hypot(*self.frame.zero_of(origin))

    def move_frame(self, origin: LocalOrigin, shift_enu_m: PositionEnu | None) -> None:
        """Transform every local position into the frame of a new origin, by a shift.

        Without a shift the new frame is far away: all positions but home are dropped, and home as
        well if it is too far away for a height above it.
        """
        home, kept, before = self.reported_home_enu_m, self.home_enu_m, self.origin
        track = self.track
        if shift_enu_m is None:
            self.forget_frame()
        else:
            self.shift(shift_enu_m)
            self.home_enu_m = self.reported_home_enu_m = None
        self.track, self.frame = track, origin
        if before is None or home is None or kept is None:
            return
        turned = origin.enu_from_geodetic(*before.geodetic_from_enu(kept))
        if all(abs(value) <= MAX_HOME_DISTANCE_M for value in turned):
            self.reported_home_enu_m = origin.enu_from_geodetic(*before.geodetic_from_enu(home))
            self.home_enu_m = turned

    @property
    def position_enu_m(self) -> PositionEnu | None:
        """Latest position; None before the first one."""
        latest = self.track.latest
        return None if latest is None else latest.position_enu_m

    @property
    def motion(self) -> Motion | None:
        """Inputs of the guard, or None without a position or a home."""
        latest, home = self.track.latest, self.home_enu_m
        if latest is None or home is None:
            return None
        return Motion(latest.position_enu_m, latest.velocity_enu_mps, home, self.battery_pct)

    @property
    def mode(self) -> FlightMode:
        """Latest reported mode."""
        return FlightMode.UNKNOWN if self.heartbeat is None else self.heartbeat.mode

    @property
    def autopilot(self) -> Autopilot:
        """Kind of autopilot by its HEARTBEAT."""
        return Autopilot.OTHER if self.heartbeat is None else self.heartbeat.autopilot

    def name_of(self, mode: FlightMode) -> str:
        """Return the name of a mode in the autopilot's tools."""
        if self.heartbeat is not None and self.heartbeat.mode is mode:
            return mode_text(self.heartbeat)
        return mode_name(mode, self.autopilot)

    @property
    def guided_name(self) -> str:
        """Name of the mode that obeys setpoints, in the autopilot's tools."""
        name = self.name_of(FlightMode.OFFBOARD)
        return name if self.autopilot is Autopilot.ARDUPILOT else f"{name} mode"

    @property
    def is_armed(self) -> bool:
        """True if the vehicle was armed when last reported."""
        return self.heartbeat is not None and self.heartbeat.is_armed

    @property
    def is_ours(self) -> bool:
        """True if the vehicle obeys our setpoints: armed and in offboard."""
        return self.is_armed and self.mode is FlightMode.OFFBOARD

    @property
    def obeys_setpoints(self) -> bool:
        """True if setpoints would be obeyed once the mode is offboard.

        ArduPilot ignores them on the ground, and one during its take-off would end the climb.
        """
        return self.autopilot is not Autopilot.ARDUPILOT or self.landed is LandedState.IN_AIR

    @property
    def vehicle_class(self) -> VehicleClass | None:
        """Class of the vehicle; None before the first HEARTBEAT."""
        return None if self.heartbeat is None else self.heartbeat.vehicle_class

    @property
    def objection(self) -> str | None:
        """Reason not to control this vehicle: class, autopilot, or doubtful identity; or None."""
        vehicle_class = self.vehicle_class
        if vehicle_class is None:
            return self.identity_problem
        return vehicle_refusal(vehicle_class, self.autopilot) or self.identity_problem

    @property
    def wants_prestream(self) -> bool:
        """True if setpoints must flow before offboard can be entered.

        PX4 refuses the mode without them. ArduPilot needs none, and would follow a running stream
        at once when GUIDED returns.
        """
        return self.heartbeat is not None and self.heartbeat.autopilot is not Autopilot.ARDUPILOT

    @property
    def height_m(self) -> float | None:
        """Height above home; None without a position or a home."""
        position, home = self.position_enu_m, self.home_enu_m
        return None if position is None or home is None else position[2] - home[2]

    def is_position_fresh(self, now_s: float) -> bool:
        """Return True if the newest position is young enough for guidance."""
        latest = self.track.latest
        return latest is not None and now_s - latest.time_s <= STALE_STATE_S

    def is_landed_fresh(self, now_s: float) -> bool:
        """Return True if the landed state was reported lately."""
        return now_s - self._landed_s <= LANDED_TIMEOUT_S

    def is_link_lost(self, now_s: float) -> bool:
        """Return True if no valid frame of the autopilot arrived for `LINK_LOST_S`."""
        return self.heard_s is None or now_s - self.heard_s > LINK_LOST_S

    def is_usable(self, now_s: float) -> bool:
        """Return True if it can be guided at all: heard, positioned, with a home."""
        return (
            self.objection is None
            and self.mode_watch.is_known(now_s)
            and self.home_enu_m is not None
            and self.has_origin
            and self.is_position_fresh(now_s)
            and not self.is_link_lost(now_s)
        )

    @property
    def has_origin(self) -> bool:
        """True if the origin is known, or setpoints do not need it."""
        return self.origin is not None or not self._needs_origin

    def missing_position_text(self, now_s: float) -> str:
        """Return the name of the missing position: none at all, or late ones of a slow link."""
        latest = self.track.latest
        if latest is None or now_s - latest.time_s > LINK_LOST_S + STALE_STATE_S:
            return "a local position"
        return f"a local position that is not {STALE_STATE_S:g} s late (is the link slow?)"

    def _move(self, event: events.VehicleMoved) -> None:
        if not is_plausible(event.state):
            return
        self.track.add(event.state)
        self.mode_watch.note_stamp(event.state.time_s, event.order)
        position_enu_m = event.state.position_enu_m
        if self._counted_at is None or not self.is_armed:
            self._counted_at = position_enu_m
            return
        step_m = math.dist(position_enu_m, self._counted_at)
        if step_m >= MIN_STEP_M:
            self.distance_m += step_m
            self._counted_at = position_enu_m
