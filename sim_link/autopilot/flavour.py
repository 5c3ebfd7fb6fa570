"""Decisions of an autopilot, and their order in every physics step.

Theory of operation. A flavour owns the mode, the arming and the setpoints of one aircraft. Per step
it watches its time-outs and failsafes, settles what changed (the controller gets a new task, an
occurrence is noted), flies, and looks at the ground. Commands and setpoints arrive between steps
and settle at once, so that an answer and the state agree.

The module also has the decoding of commands that both autopilots share, and `Firmware`: identity
and protocol behaviour of a firmware. The rest is in tables as well: its commands (`flight_modes`),
its failsafes and its parameters (`parameters.csv`).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Container, Mapping, Sequence
from importlib.resources import files
from typing import Any, NamedTuple, get_type_hints

import msgspec

from companion.domain import FlightMode, LandedState, PositionEnu
from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.aircraft import Aircraft, Occurrence
from sim_link.autopilot.control_inputs import (
    Echo,
    Setpoint,
    SetpointMonitor,
    TargetMessage,
    is_on_earth,
)
from sim_link.autopilot.flight_controller import Task
from sim_link.autopilot.mission_executor import LegKind, MissionLeg
from sim_link.autopilot.protocols.command_protocol import Command, CommandForms, CommandResult
from sim_link.autopilot.protocols.message_streams import RequestProfile, StreamProfile
from sim_link.autopilot.protocols.parameter_protocol import ParameterProfile, ParameterStore
from sim_link.autopilot.protocols.plan_items import MissionState
from sim_link.autopilot.protocols.plan_rules import MAX_ALTITUDE_M, PlanRules

ACCEPTED = CommandResult.ACCEPTED
TEMPORARILY_REJECTED = CommandResult.TEMPORARILY_REJECTED
DENIED = CommandResult.DENIED
UNSUPPORTED = CommandResult.UNSUPPORTED
FAILED = CommandResult.FAILED
UNSUPPORTED_MAV_FRAME = CommandResult.UNSUPPORTED_MAV_FRAME

MAX_DISTANCE_M = 1e5
"""Longest distance for which a flat local frame is valid."""
MAX_HEIGHT_M = 1000.0
"""Largest height above home of a take-off or a goal, in m."""
CHANGE_MODE_FLAG = 1
FORCE_ARMING = 21196
"""Magic number of MAV_CMD_COMPONENT_ARM_DISARM's second parameter."""

Handler = Callable[[Any, Command, float], int]
"""Executes a flavour's command at a time; returns a MAV_RESULT or `UNANSWERED`."""


def is_valid_position(position: tuple[int, int]) -> bool:
    """Return True if latitude and longitude are valid; 0/0 means unknown."""
    return position != (0, 0) and is_on_earth(*position)


def is_altitude(altitude_m: float) -> bool:
    """Return True if an altitude is finite and in range."""
    return abs(altitude_m) <= MAX_ALTITUDE_M


def is_force(value: float) -> bool | None:
    """Return True if ARM_DISARM's second parameter forces; None if it is invalid."""
    if math.isnan(value) or value == 0.0:
        return False
    return True if value == FORCE_ARMING else None


def may_change_mode(command: Command) -> bool:
    """Return True if DO_REPOSITION may choose the mode that goes there."""
    return bool((command.whole(2) or 0) & CHANGE_MODE_FLAG)


def chooses(mode: object) -> Handler:
    """Return the handler of a command that only chooses a mode."""
    return lambda flavour, _, now_s: int(flavour.choose(mode, now_s))


def answers(result: CommandResult) -> Handler:
    """Return the handler of a command without effect."""
    return lambda *_: result


def set_home(flavour: AutopilotFlavour, command: Command, _now_s: float) -> int:
    """Handle DO_SET_HOME: here (first parameter 1), or at a position in a known frame."""
    aircraft, firmware = flavour.aircraft, flavour.firmware
    if command.params[0] == 1.0:
        aircraft.set_home(aircraft.motion.position_enu_m, is_given=False)
        return ACCEPTED
    frame = mavlink.MAV_FRAME_GLOBAL if command.frame is None else command.frame
    position, altitude_m = command.position_e7, command.params[6]
    if position is None or not is_valid_position(position) or not is_altitude(altitude_m):
        return firmware.refusal
    home = aircraft.position_from(*position, altitude_m, frame)
    if home is None:
        return firmware.frame_refusal
    if any(abs(axis) > MAX_DISTANCE_M for axis in home):
        return firmware.refusal
    aircraft.set_home(home, is_given=firmware.keeps_given_home)
    return ACCEPTED


def terminate(flavour: AutopilotFlavour, command: Command, _now_s: float) -> int:
    """Handle DO_FLIGHTTERMINATION."""
    if command.params[0] != 1.0:
        return flavour.firmware.refusal
    flavour.aircraft.notify(*flavour.firmware.termination)
    return flavour.disarm(is_forced=True)


class Firmware(NamedTuple):
    """Identity of an autopilot's firmware, and its behaviour in each protocol."""

    autopilot: int
    version: int
    capabilities: int
    refusal: CommandResult
    """Result of a command whose parameters make no sense."""
    frame_refusal: CommandResult
    """Result of a position in an unknown frame."""
    busy: CommandResult
    """Result of a calibration or restart command while armed."""
    calibrates_at_once: bool
    """True if a calibration is done at once; otherwise it takes its time, and reports progress."""
    termination: tuple[int, str]
    """MAV_SEVERITY and text of a flight termination."""
    keeps_given_home: bool
    """True if arming does not move a home that a station set."""
    commands: CommandForms
    requests: RequestProfile
    streams: StreamProfile
    parameters: ParameterProfile
    plans: PlanRules
    rejects_for_others: bool
    """True if a command for a system or component that it never heard is answered by FAILED."""
    empty_calibration: CommandResult
    """Result of a calibration of no sensor."""
    names_timesync_target: bool
    timesync_dated_back_baud: int | None
    """Baud rate by which the arrival of a TIMESYNC request is dated back; null: it is not."""
    answers_ping: bool
    reports_mode_at_once: bool
    """True if every change of mode sends an extra HEARTBEAT."""
    obeys_rc_override: bool
    takes_origin: bool
    """True if a station may move the EKF origin; otherwise it comes from GNSS."""
    first_mission_item: int
    """Index of the first mission item that is flown: 1 where item 0 is home."""
    home_orientation: tuple[float, float, float, float]
    answers_for_others: bool
    """True if it obeys commands to unheard components of its system, as itself."""
    dialect: Container[int] | None = None
    """Ids of the messages that it forwards; None if it forwards all."""
    gives_plan_ids: bool = False
    """True if MISSION_CURRENT has ids of mission, fence and rally points."""


def read_firmware(
    package: str, streams: StreamProfile, dialect: Container[int] | None = None
) -> Firmware:
    """Read a package's `firmware.yaml`; names of MAVLink constants are replaced by their values."""
    text = files(package).joinpath("firmware.yaml").read_bytes()
    kinds = get_type_hints(Firmware)
    fields = {
        name: msgspec.convert(_with_values(value), kinds[name])
        for name, value in msgspec.yaml.decode(text).items()
    }
    return Firmware(**fields, streams=streams, dialect=dialect)


def _with_values(value: object) -> object:
    match value:
        case str():
            return getattr(mavlink, value, value)
        case list():
            return [_with_values(each) for each in value]
        case dict():
            return {key: _with_values(each) for key, each in value.items()}
    return value


class HeartbeatState(NamedTuple):
    """Mode and status fields of HEARTBEAT."""

    base_mode: int
    custom_mode: int
    system_status: int


class FenceState(NamedTuple):
    """Geofence fields of SYS_STATUS."""

    is_present: bool
    is_enabled: bool
    is_breached: bool


class AutopilotFlavour(ABC):
    """One autopilot on one aircraft."""

    firmware: Firmware

    def __init__(self, aircraft: Aircraft, parameters: ParameterStore) -> None:
        self.aircraft = aircraft
        self.parameters = parameters
        self.handlers: Mapping[int, Handler] = {}
        """Handler of each MAV_CMD; any other command is unsupported."""
        self.setpoints = SetpointMonitor()
        self.occurrences: list[Occurrence] = []
        """Occurrences since the list was last emptied by its reader."""
        self.leg: MissionLeg | None = None
        self.changes = 0
        """Number of changes of mode and arming."""
        self._seen: tuple[FlightMode, bool, Task] | None = None
        self._landed_s: float | None = None

    @property
    @abstractmethod
    def mode(self) -> FlightMode:
        """The mode that is flown."""

    @property
    @abstractmethod
    def is_failsafe(self) -> bool:
        """True if a failsafe is acting."""

    @property
    @abstractmethod
    def reason(self) -> str:
        """Reason of the acting failsafe."""

    @property
    @abstractmethod
    def task(self) -> Task:
        """Task of the flight controller."""

    @property
    @abstractmethod
    def flown_setpoint(self) -> Setpoint:
        """The setpoint that FOLLOW flies."""

    @abstractmethod
    def arming_refusal(self, now_s: float) -> str | None:
        """Return the reason why it could not be armed now, or None."""

    @abstractmethod
    def fence_margin_m(self, position: PositionEnu) -> float:
        """Return the distance from a position to the nearest fence breach, negative in one."""

    @abstractmethod
    def fence_state(self, position: PositionEnu) -> FenceState:
        """Return the state of the fence for a vehicle at `position`."""

    @abstractmethod
    def heartbeat_state(self, now_s: float) -> HeartbeatState:
        """Return the state for HEARTBEAT."""

    @abstractmethod
    def pilot_chooses(self, mode: FlightMode, now_s: float) -> None:
        """Handle the pilot's mode switch."""

    @abstractmethod
    def disarm(self, *, is_forced: bool) -> int:
        """Handle a request to disarm, forced also in the air; return a MAV_RESULT."""

    @abstractmethod
    def take_setpoint(self, message: TargetMessage, now_s: float) -> None:
        """Take SET_POSITION_TARGET_LOCAL_NED, _GLOBAL_INT or SET_ATTITUDE_TARGET."""

    @abstractmethod
    def echo(self) -> Echo | None:
        """Return the target for POSITION_TARGET_*; None while none is sent."""

    @abstractmethod
    def disarm_delay_s(self) -> float | None:
        """Return the seconds armed on the ground until it disarms itself; None: never."""

    @abstractmethod
    def _watch(self, now_s: float) -> None:
        """Check time-outs and failsafes."""

    @abstractmethod
    def _after_flying(self, now_s: float) -> None:
        """End a takeoff or a mission that is complete."""

    @property
    def available_modes(self) -> Sequence[Message]:
        """AVAILABLE_MODES of each mode; empty: the autopilot does not have the message."""
        return ()

    def has_home(self, _now_s: float) -> bool:
        """Return True if origin and home are known."""
        return True

    def has_position(self, _now_s: float) -> bool:
        """Return True if the position is reported."""
        return self.aircraft.estimator.is_position_valid

    @property
    def is_armed(self) -> bool:
        """True if the motors may turn."""
        return self.aircraft.is_armed

    @property
    def landed_state(self) -> LandedState:
        """EXTENDED_SYS_STATE.landed_state."""
        if self.aircraft.body.is_on_ground or self.aircraft.time_s < self.aircraft.landed_until_s:
            return LandedState.ON_GROUND
        match self.task:
            case Task.TAKE_OFF:
                return LandedState.TAKEOFF
            case Task.LAND:
                return LandedState.LANDING
        return LandedState.IN_AIR

    def step(self, now_s: float) -> None:
        """Advance by one physics step, which ends at `now_s` seconds since boot."""
        self.aircraft.time_s = now_s
        self._watch(now_s)
        self.settle(now_s)
        self._fly(now_s)
        self._after_flying(now_s)
        self.settle(now_s)
        self._watch_ground(now_s)

    def command(self, command: Command, now_s: float) -> int:
        """Handle a command; return a MAV_RESULT."""
        handler = self.handlers.get(command.number)
        result = UNSUPPORTED if handler is None else handler(self, command, now_s)
        self.settle(now_s, "commanded")
        return result

    def settle(self, now_s: float, why: str = "") -> None:
        """Give the controller a changed task and note the change; called after every change."""
        mode, is_armed, task = seen = (self.mode, self.is_armed, self.task)
        if seen == self._seen:
            return
        old_mode, was_armed, old_task = self._seen or seen
        is_first, self._seen = self._seen is None, seen
        if is_armed != was_armed:
            self._armed_changed(is_armed)
        if old_task is Task.FLY_MISSION is not task:
            self._leave_mission()
        self.aircraft.controller.enter(task, self.aircraft.motion)
        if task is Task.FLY_MISSION and is_armed and not is_first:
            self.aircraft.mission.start()
        if (mode, is_armed) == (old_mode, was_armed):
            return
        self.changes += 1
        texts = []
        if is_armed != was_armed:
            texts.append("armed" if is_armed else "disarmed")
        if mode is not old_mode:
            if self.is_failsafe:
                why = f"failsafe: {self.reason}"
            reason = f" ({why})" if why else ""
            texts.append(f"mode {old_mode.value} -> {mode.value}{reason}")
        self.note(now_s, ", ".join(texts))

    def send_rejection(self, prefix: str, why: str | None) -> None:
        """Send a text with the reason why it cannot be armed, if there is one."""
        if why is not None:
            self.aircraft.notify(mavlink.MAV_SEVERITY_CRITICAL, f"{prefix}: {why}")

    def note(self, now_s: float, text: str) -> None:
        """Add an occurrence with the current mode to the vehicle's record."""
        self.occurrences.append(Occurrence(now_s, self.mode, self.aircraft.is_armed, text))

    def _armed_changed(self, is_armed: bool) -> None:
        """Set home where it is armed, unless a station set it."""
        aircraft, here = self.aircraft, self.aircraft.motion.position_enu_m
        aircraft.has_flown, self._landed_s = False, None
        if not is_armed or aircraft.is_home_given:
            return
        aircraft.home_set_s = aircraft.time_s
        if here != aircraft.home_enu_m:
            aircraft.set_home(here, is_given=False)

    def _leave_mission(self) -> None:
        """Leave the mission, which continues where it was; a finished one stays finished."""
        if self.leg is None or self.leg.kind is not LegKind.RETURN:
            self.aircraft.mission.pause()
            self.leg = None

    def _fly(self, now_s: float) -> None:
        aircraft, controller = self.aircraft, self.aircraft.controller
        if not aircraft.is_armed:
            aircraft.move(None, None)
            return
        body = aircraft.motion
        if controller.task is Task.FLY_MISSION:
            position, is_on_ground = body.position_enu_m, body.is_on_ground
            self.leg = aircraft.mission.leg(position, is_on_ground and aircraft.has_flown, now_s)
        sticks = aircraft.sticks.read(now_s) if controller.task is Task.FLY_BY_STICKS else None
        setpoint = self.flown_setpoint
        aircraft.move(
            controller.command(setpoint, self.leg, sticks, body),
            controller.yaw_ned_rad(setpoint, sticks, aircraft.heading_ned_rad),
        )

    @property
    def _is_mission_over(self) -> bool:
        return self.aircraft.mission.state is MissionState.COMPLETE

    def _watch_ground(self, now_s: float) -> None:
        """Note touchdowns, and disarm some time after one."""
        aircraft = self.aircraft
        if not aircraft.body.is_on_ground:
            if not aircraft.has_flown and aircraft.is_armed:
                self.note(now_s, "in the air")
            aircraft.has_flown = True
            self._landed_s = None
            return
        delay_s = self.disarm_delay_s() if aircraft.is_armed else None
        if delay_s is None:
            self._landed_s = None
            return
        if self._landed_s is None:
            self._landed_s = now_s
            if aircraft.has_flown:
                self.note(now_s, "on the ground")
        if now_s - self._landed_s >= delay_s:
            self.disarm(is_forced=True)
            self.settle(now_s, "landed")
