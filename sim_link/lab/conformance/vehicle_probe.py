"""Ground station that queries a vehicle, and flies it to test it.

Methods that await or require something raise `Violation` if it does not occur.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress

from companion.errors import CompanionError
from companion.mav.dialect import Message, mavlink
from sim_link.lab.conformance import mavlink_oracle as mav
from sim_link.lab.conformance.mavlink_oracle import Triple
from sim_link.lab.conformance.rules import (
    AutopilotNotes,
    Flavour,
    NotApplicable,
    NotReady,
    Role,
    Violation,
    assume,
    autopilot_notes,
    require,
)
from sim_link.lab.conformance.station import Baseline, M, ProbeLink, Station, heartbeat, source_of

FIRST_HEARTBEAT_S = 10.0
READY_S = 90.0
"""Longest wait for arming: a real autopilot needs 20 to 45 s from boot."""
SHORT_LOOK_S = 2.0
ARM_S = 15.0
"""Time for which arming may be refused although SYS_STATUS reports that it is possible."""
STREAM_S = 15.0
SILENCE_S = 8.0
"""Silence, s, after which a vehicle is assumed to have crashed or to hang."""
SECOND_CLIENT_S = 3.0
ACK_S = 2.0
POSITION_INTERVAL_S = 0.05
BOOT_S = 60.0
SPENT_PERCENT = 30
"""Charge at which a battery may not last for the next flight."""
FLIGHT_HEIGHT_M = 10.0
CLIMB_S = 40.0

PADDING = 7
Interval = mavlink.MAVLink_message_interval_message
GET_INTERVAL = mavlink.MAV_CMD_GET_MESSAGE_INTERVAL


class VehicleProbe(Station):
    """Queries one vehicle, as a ground station would, and tests it in short flights."""

    role = Role.VEHICLE

    def __init__(self, link: ProbeLink, signing_key: bytes | None = None) -> None:
        super().__init__(link)
        self.signing_key = signing_key
        self.flavour = Flavour.PX4
        self.target = (1, mavlink.MAV_COMP_ID_AUTOPILOT1)
        self.baseline = Baseline()

    def attach(self) -> None:
        """Wait for the vehicle and learn its ids and flavour; `NotApplicable`: none is heard."""
        try:
            first = self.expect(
                mav.Heartbeat,
                lambda m: m.autopilot != mavlink.MAV_AUTOPILOT_INVALID,
                within_s=FIRST_HEARTBEAT_S,
                mark=0,
            )
        except Violation:
            raise NotApplicable(f"no autopilot heard within {FIRST_HEARTBEAT_S:g} s") from None
        self.target = source_of(first)
        if self.baseline.custom_mode is None:
            self.baseline.custom_mode = first.custom_mode
        for flavour, number in mav.AUTOPILOT_OF.items():
            if number == first.autopilot:
                self.flavour = flavour

    @property
    def notes(self) -> AutopilotNotes:
        """Behaviour of the real autopilot of this flavour."""
        return autopilot_notes()[self.flavour]

    @property
    def is_px4(self) -> bool:
        """True if the vehicle is a PX4."""
        return self.flavour is Flavour.PX4

    @property
    def address(self) -> tuple[int, int]:
        """Our own system and component."""
        return (self.system_id, self.component_id)

    def is_own(self, message: Message) -> bool:
        """Return True if the vehicle's autopilot sent it."""
        return source_of(message) == self.target

    def from_vehicle(self, kind: type[M], mark: int = 0) -> list[M]:
        """Return the vehicle's own messages of a kind."""
        return [message for message in self.heard(kind, mark) if self.is_own(message)]

    def latest(self, kind: type[M]) -> M:
        """Return the newest message of a kind, requested if none has arrived."""
        return self._newest(kind) or self.request(kind)

    def _newest(self, kind: type[M]) -> M | None:
        for entry in reversed(self.inbox):
            if isinstance(entry.message, kind) and self.is_own(entry.message):
                return entry.message
        return None

    def another(
        self, system_id: int = 254, component_id: int = 190, kind: int | None = mavlink.MAV_TYPE_GCS
    ) -> Station:
        """Return a second station, already heard; `NotApplicable` on links for one client.

        A server may leave it in its backlog, and a port may answer its first peer only.
        """
        link = None
        with suppress(CompanionError):
            link = None if self.baseline.serves_one_client else self.link.another()
        if link is not None:
            other = Station(link, system_id, component_id, None)
            if kind is not None:
                other.send(heartbeat(kind))
            if other.is_heard(SECOND_CLIENT_S):
                return other
        self.baseline.serves_one_client |= self.is_heard(SECOND_CLIENT_S)
        raise NotApplicable("this link serves one client only")

    def command(self, number: int, *params: float, confirmation: int = 0) -> int:
        """Send COMMAND_LONG, unused parameters NaN as MAVSDK does; return the result."""
        padded = [*params, *[mav.NAN] * (PADDING - len(params))]
        return self.result_of(mav.CommandLong(*self.target, number, confirmation, *padded), number)

    def command_int(
        self,
        number: int,
        frame: int,
        params: tuple[float, float, float, float] = (mav.NAN, mav.NAN, mav.NAN, mav.NAN),
        position: tuple[int, int, float] = (0, 0, mav.NAN),
    ) -> int:
        """Send COMMAND_INT; return the final MAV_RESULT. A global position is in 1e-7 degrees."""
        x, y, z = position
        message = mav.CommandInt(*self.target, frame, number, 0, 0, *params, x, y, z)
        return self.result_of(message, number)

    def result_of(self, message: Message, number: int) -> int:
        """Send a command; return its result after any IN_PROGRESS."""
        ack = self.ask(
            message,
            mav.Ack,
            lambda m: m.command == number and m.result != mav.IN_PROGRESS,
            within_s=ACK_S,
            what=f"COMMAND_ACK of {number}",
        )
        return int(ack.result)

    def require_result(self, wanted: int | tuple[int, ...], number: int, *params: float) -> None:
        """Send COMMAND_LONG; its MAV_RESULT must be the wanted one, or one of several."""
        result = self.command(number, *params)
        results = (wanted,) if isinstance(wanted, int) else wanted
        require(result in results, f"command {number} {params}: result {result}, not {wanted}")

    def request(self, kind: type[M], within_s: float = ACK_S) -> M:
        """Send REQUEST_MESSAGE; return the message."""
        self.require_result(mav.ACCEPTED, mav.REQUEST, float(kind.id))
        return self.expect(kind, self.is_own, within_s=within_s, mark=self.asked)

    def require_sent(
        self, kind: type[M], number: int, *params: float, where: Callable[[M], bool] | None = None
    ) -> M:
        """Send COMMAND_LONG, which must be accepted and send a message."""
        self.require_result(mav.ACCEPTED, number, *params)
        return self.expect(kind, where, mark=self.asked)

    def set_interval(self, kind: type[Message] | int, interval_s: float) -> int:
        """Send SET_MESSAGE_INTERVAL (-1 stops, 0: the default); return its MAV_RESULT.

        The default is the mode's; what a start script of PX4 had set is read before and put back.
        """
        number = kind if isinstance(kind, int) else kind.id
        intervals = self.baseline.intervals
        before_s = None if number in intervals else self._interval_s(number)
        result = self._set_interval(number, interval_s)
        if result == mav.ACCEPTED and number not in intervals:
            intervals[number] = 0.0 if before_s is None else before_s
            if before_s is None:
                self.baseline.unknown_rates.add(number)
        return result

    def restore_intervals(self) -> None:
        """Restore all changed rates."""
        for number, interval_s in sorted(self.baseline.intervals.items()):
            self._set_interval(number, interval_s)
        self.baseline.intervals.clear()

    def _interval_s(self, number: int) -> float | None:
        """Return a message's interval from MESSAGE_INTERVAL, -1: off; None: not reported.

        PX4 reports 0 for a stream that is off, and for a message that does not exist.
        """
        if self.command(GET_INTERVAL, float(number)) != mav.ACCEPTED:
            return None
        try:
            reported = self.expect(Interval, lambda m: m.message_id == number, mark=self.asked)
        except Violation:
            return None
        if reported.interval_us > 0:
            return float(reported.interval_us) / 1e6
        return -1.0 if reported.interval_us < 0 or self.is_px4 else None

    def _set_interval(self, number: int, interval_s: float) -> int:
        microseconds = interval_s * 1e6 if interval_s > 0.0 else interval_s
        return self.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, float(number), microseconds)

    def watch(self, kind: type[M], interval_s: float = POSITION_INTERVAL_S) -> None:
        """Make a message flow, and wait for the first."""
        self.set_interval(kind, interval_s)
        self.expect(kind, within_s=STREAM_S, mark=self.asked)

    def is_alive(self) -> bool:
        """Return True if the vehicle still answers (TIMESYNC)."""
        stamp = 1_000_000 + self.mark
        self.send(mav.Timesync(0, stamp))
        return self.is_synchronised(stamp, self.asked, ACK_S)

    def is_synchronised(self, stamp: int, mark: int, within_s: float) -> bool:
        """Advance the time; return True if a TIMESYNC with `ts1` = `stamp` arrives after a mark."""
        return self.run_until(
            lambda: any(m.ts1 == stamp for m in self.heard(mav.Timesync, mark)), within_s
        )

    def require_hearing(self) -> None:
        """Require, after a probe for silence, that the vehicle still hears the station."""
        require(self.is_alive(), "nothing is answered any more")

    def require_no_answer(
        self, messages: Sequence[Message], kind: type[M], where: Callable[[M], bool] | None = None
    ) -> None:
        """Send messages that nothing of a kind may follow, though the vehicle hears us."""
        super().require_no_answer(messages, kind, where)
        self.require_hearing()

    def heartbeat(
        self,
        where: Callable[[mav.Heartbeat], bool] | None = None,
        within_s: float = 3.0,
        what: str = "",
    ) -> mav.Heartbeat:
        """Return a HEARTBEAT of the vehicle that is newer than this call."""
        return self.expect(
            mav.Heartbeat,
            lambda m: self.is_own(m) and (where is None or where(m)),
            within_s=within_s,
            what=f"HEARTBEAT {what or 'of the vehicle'}",
        )

    def is_armed(self) -> bool:
        """Return True if a new HEARTBEAT reports armed."""
        return bool(self.heartbeat().base_mode & mav.ARMED)

    def is_in(self, mode: str) -> bool:
        """Return True if a new HEARTBEAT shows the mode."""
        return bool(self.heartbeat().custom_mode == mav.custom_mode(self.flavour, mode))

    def await_mode(self, mode: str, within_s: float = 5.0) -> None:
        """Advance the time until a HEARTBEAT shows a mode."""
        wanted = mav.custom_mode(self.flavour, mode)
        self.heartbeat(lambda m: m.custom_mode == wanted, within_s, f"in {mode}")

    def await_disarmed(self, within_s: float) -> None:
        """Advance the time until a HEARTBEAT reports disarmed."""
        self.heartbeat(lambda m: not m.base_mode & mav.ARMED, within_s, "of a disarmed vehicle")

    def set_mode(self, mode: str) -> int:
        """Send DO_SET_MODE; return its MAV_RESULT."""
        return self.command(mavlink.MAV_CMD_DO_SET_MODE, *mav.set_mode_params(self.flavour, mode))

    def require_mode(self, mode: str) -> None:
        """DO_SET_MODE, which must be accepted."""
        result = self.set_mode(mode)
        require(result == mav.ACCEPTED, f"{mode}: result {result}")

    def require_disarmed(self) -> None:
        """Require a disarmed vehicle for a rule on the ground; raise `NotApplicable` if armed."""
        assume(not self.is_armed(), "the vehicle is armed")

    def position(self) -> Triple:
        """Return north, east and down of the newest LOCAL_POSITION_NED, after a step of time."""
        report = self.expect(mav.LocalPosition, within_s=3.0)
        return (report.x, report.y, report.z)

    def speed(self) -> Triple:
        """Return the velocity north, east and down of the newest LOCAL_POSITION_NED."""
        report = self.expect(mav.LocalPosition, within_s=3.0)
        return (report.vx, report.vy, report.vz)

    def set_home(
        self, position: tuple[int, int, float], frame: int = mavlink.MAV_FRAME_GLOBAL
    ) -> int:
        """Send DO_SET_HOME as COMMAND_INT; return its MAV_RESULT."""
        if self.baseline.home is None:
            home = self.home()
            self.baseline.home = (home.latitude, home.longitude, home.altitude / 1e3)
        return self.command_int(mavlink.MAV_CMD_DO_SET_HOME, frame, (0.0,) * 4, position)

    def home(self) -> mav.HomePosition:
        """Request and return HOME_POSITION."""
        return self.request(mav.HomePosition)

    def get_ready(self) -> None:
        """Wait until it can be armed, in the mode that flights begin in."""
        self._await_position()
        self.set_mode("hold" if self.is_px4 else "offboard")
        self.watch(mav.SysStatus, 0.2)
        self.await_prearm()

    def _await_position(self) -> None:
        """Wait until it has a position; `NotReady`: it does not get one.

        ArduPilot reports PREARM_CHECK as good in STABILIZE, which needs no position, and refuses
        GUIDED until its EKF has one, 18 s later.
        """
        self.set_interval(mav.LocalPosition, POSITION_INTERVAL_S)
        mark = self.asked

        def has_position() -> bool:
            return any(isinstance(e.message, mav.LocalPosition) for e in self.inbox[mark:])

        self.run_until(lambda: has_position() or self._is_silent(), SHORT_LOOK_S)
        if not has_position() and not self.baseline.unready:
            what = f"LOCAL_POSITION_NED within {READY_S:g} s"
            self.baseline.report(f"waiting for the vehicle: {what}")
            self.run_until(lambda: has_position() or self._is_silent(), READY_S)
        if not has_position():
            self.baseline.unready = (
                self.baseline.unready or f"no LOCAL_POSITION_NED within {READY_S:g} s"
            )
            require(not self._is_silent(), "nothing is heard any more")
            raise NotReady(self.baseline.unready)

    def reboot(self) -> None:
        """Restart the autopilot; a simulated one has a fresh battery then."""
        self.require_result(mav.ACCEPTED, mav.REBOOT, 1.0, 0.0, 0.0)
        mark = self.mark
        back = self.run_until(lambda: bool(self.heard(mav.Heartbeat, mark)), BOOT_S)
        require(back, f"it did not come back within {BOOT_S:g} s of a reboot")

    def await_prearm(self) -> None:
        """Wait until SYS_STATUS reports that it can be armed in its mode; else raise `NotReady`."""
        mark = self.mark
        baseline = self.baseline
        if self._is_ready(SHORT_LOOK_S):
            baseline.unready = ""
            return
        if not baseline.unready:
            what = f"ready to arm within {READY_S:g} s (SYS_STATUS, PREARM_CHECK)"
            baseline.report(f"waiting for the vehicle: {what}")
            if self._is_ready(READY_S):
                return
            require(not self._is_silent(), "nothing is heard any more")
            baseline.unready = f"not {what}{self._reasons_since(mark)}"
        raise NotReady(baseline.unready)

    def _is_ready(self, within_s: float) -> bool:
        """Advance the time until it can be armed or is silent; return True if it can."""

        def can_arm() -> bool:
            status = self._newest(mav.SysStatus)
            return status is not None and is_ready(status)

        self.run_until(lambda: can_arm() or self._is_silent(), within_s)
        return can_arm()

    def _is_silent(self) -> bool:
        return bool(self.inbox) and self.now_s - self.inbox[-1].time_s > SILENCE_S

    def _reasons_since(self, mark: int) -> str:
        """Return the vehicle's texts since a mark, to be appended to an error message."""
        texts = dict.fromkeys(text.text.strip() for text in self.from_vehicle(mav.StatusText, mark))
        return f"; it says: {'; '.join(list(texts)[-3:])}" if texts else ""

    def arm(self) -> None:
        """Get ready and arm; `NotReady`: it is refused repeatedly."""
        self.get_ready()
        percent = self.latest(mav.SysStatus).battery_remaining
        if 0 <= percent < SPENT_PERCENT:
            if not self.baseline.allows_harm:
                raise NotReady(f"battery at {percent} %: charge it (--allow-harm reboots for it)")
            self.reboot()
            self.get_ready()
        if self.baseline.start_e7 is None:
            self.baseline.start_e7 = self.where_e7()
        mark, last_s = self.mark, self.now_s + ARM_S
        while (result := self.command(mav.ARM, 1.0, 0.0)) != mav.ACCEPTED:
            if self.now_s > last_s:
                reasons = self._reasons_since(mark)
                raise NotReady(f"arming is refused for {ARM_S:g} s: result {result}{reasons}")
            self.run(1.0)

    def take_off(self, height_m: float = FLIGHT_HEIGHT_M) -> None:
        """Arm, climb above home and hover there."""
        self.arm()
        params = self.takeoff_params(height_m)
        start_down_m = self.position()[2]
        self.require_result(mav.ACCEPTED, mav.TAKE_OFF, *params)
        climbed = self.run_until(
            lambda: start_down_m - self.position()[2] > height_m - 0.5, CLIMB_S
        )
        require(climbed, f"did not climb {height_m:g} m within {CLIMB_S:g} s")
        if self.is_px4:
            self.await_mode("hold", CLIMB_S)
        self.run(2.0)

    def takeoff_params(self, height_m: float) -> list[float]:
        """Parameters of NAV_TAKEOFF to a height above home, as the flavour takes them."""
        if self.is_px4:
            return [*[mav.NAN] * 6, self.home().altitude / 1e3 + height_m]
        return [*[0.0] * 6, height_m]

    def reposition(self, frame: int, position: tuple[int, int, float], flags: float = 1.0) -> int:
        """Send DO_REPOSITION as COMMAND_INT; return its MAV_RESULT."""
        return self.command_int(
            mavlink.MAV_CMD_DO_REPOSITION, frame, (-1.0, flags, 0.0, mav.NAN), position
        )

    def where_e7(self) -> tuple[int, int]:
        """Request the position; return latitude and longitude, 1e-7 degrees."""
        report = self.request(mav.GlobalPosition)
        return (report.lat, report.lon)


def is_ready(status: mav.SysStatus) -> bool:
    """Return True unless SYS_STATUS reports that the vehicle cannot be armed."""
    is_reported = bool(status.onboard_control_sensors_present & mav.PREARM)
    return not is_reported or bool(status.onboard_control_sensors_health & mav.PREARM)


def require_unmoved(before: Sequence[float], after: Sequence[float], limit_m: float) -> None:
    """Require that two positions differ by no more than a limit."""
    moved_m = math.dist(before, after)
    require(moved_m <= limit_m, f"moved by {moved_m:.1f} m")
