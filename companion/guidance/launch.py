"""The automatic launch: arm, take off, request offboard. For simulation; tried only once.

PX4: arm in hold, NAV_TAKEOFF, climb, more than a second of setpoints, then OFFBOARD (PX4 user
guide, offboard mode). ArduPilot: GUIDED first, arm, NAV_TAKEOFF; position targets take over after
the climb.

PX4 switches to hold by itself only at the end of its takeoff: hold further down was selected by a
pilot, and ends the launch. In the last metre the two look the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from companion.domain import Autopilot, FlightMode
from companion.guidance.commands import Arm, Command, SetMode, TakeOff
from companion.guidance.events import HeartbeatReceived, Outcome, RequestAnswered, RequestKind
from companion.guidance.vehicle import mode_name, mode_text

READY_TIMEOUT_S = 120.0
"""PX4 needs 34 to 38 s after boot until it can be armed; a cold GPS needs longer."""
CLIMB_TIMEOUT_S = 90.0
ARM_RETRY_S = 2.0
UNANSWERED_LIMIT = 3
"""Repetitions of an unanswered request; commands are idempotent."""
PRESTREAM_S = 1.2
"""PX4 requires setpoints for more than a second before it enters offboard."""
MODE_TIMEOUT_S = 5.0
BLIND_S = 10.0
"""Time without mode, position or link after which the launch is aborted."""
CLIMBED_SHARE = 0.9
TOP_M = 1.0
"""Largest undershoot of PX4's takeoff altitude (NAV_MC_ALT_RAD, 0.8 m, and noise)."""
PX4_MODES = frozenset({FlightMode.HOLD, FlightMode.TAKEOFF, FlightMode.READY})
"""Modes of an armed PX4 during a launch; ArduPilot holds only when a person selects it."""
LIFTED_M, LIFT_S = 1.0, 8.0
"""Height in m reached within this time in s if a take-off refused on repetition has begun."""


class Stage(Enum):
    """Stage of the launch."""

    READY = "waiting until the autopilot can be armed"
    MODE = "requesting the launch mode"
    ARM = "arming"
    TAKE_OFF = "taking off"
    CLIMB = "climbing"
    PRESTREAM = "streaming setpoints before offboard"
    OFFBOARD = "requesting offboard"


REQUESTS: dict[Stage, tuple[RequestKind, Stage]] = {
    Stage.MODE: (RequestKind.SET_MODE, Stage.ARM),
    Stage.ARM: (RequestKind.ARM, Stage.TAKE_OFF),
    Stage.TAKE_OFF: (RequestKind.TAKE_OFF, Stage.CLIMB),
    Stage.OFFBOARD: (RequestKind.SET_MODE, Stage.OFFBOARD),
}
"""Request of each stage, and the stage that follows once it is accepted."""


@dataclass(frozen=True, slots=True)
class LaunchView:
    """Inputs of the launch at one tick."""

    now_s: float
    heartbeat: HeartbeatReceived
    height_m: float
    """Height above home."""
    home_up_m: float
    has_origin: bool = True
    """True if altitudes above sea level are known, which PX4 needs for the takeoff."""


class Launch:
    """One attempt to take off to `altitude_m` above home and enter offboard."""

    def __init__(self, altitude_m: float, started_s: float) -> None:
        self.altitude_m = altitude_m
        self.stage = Stage.READY
        self.failure: str | None = None
        self._since_s = started_s
        self._retry_s = started_s
        self._seen_s = started_s
        """Last time at which all inputs of the launch were known."""
        self._is_asked = False
        self._unanswered = 0
        self._modes: frozenset[FlightMode] = frozenset()
        """Modes that the launch itself passes through."""
        self._was_armed = False
        self._refused: str | None = None
        """Reason of a refused repetition: ArduPilot refuses it once a take-off has begun."""
        self._takeoff: RequestAnswered | HeartbeatReceived | None = None
        """Latest evidence that the takeoff has begun."""
        self._offboard_accepted: RequestAnswered | None = None
        self._needs_prestream = True

    @property
    def is_at_offboard(self) -> bool:
        """True while the launch streams setpoints before offboard or waits for that mode."""
        return self.stage in (Stage.PRESTREAM, Stage.OFFBOARD)

    @property
    def has_asked(self) -> bool:
        """True once the launch has sent a request to the autopilot."""
        return self.stage is not Stage.READY

    @property
    def may_be_flying(self) -> bool:
        """True if the vehicle may be armed by now, reported or not."""
        return self.stage in (Stage.TAKE_OFF, Stage.CLIMB, Stage.PRESTREAM, Stage.OFFBOARD)

    def observe(self, heartbeat: HeartbeatReceived, height_m: float | None) -> str | None:
        """Return the reason why a heartbeat, at a height above home, aborts the launch, or None."""
        if not self.has_asked:
            return None
        if not heartbeat.is_armed:
            return "disarmed" if self._was_armed else None
        self._was_armed = True
        if heartbeat.is_failsafe:
            return "failsafe"
        is_offboard = self.is_at_offboard and heartbeat.mode is FlightMode.OFFBOARD
        if is_offboard or self._is_on_the_way(heartbeat, height_m):
            return None
        return f"mode is {mode_text(heartbeat)}"

    def _is_on_the_way(self, heartbeat: HeartbeatReceived, height_m: float | None) -> bool:
        """Return True if the reported mode is one that the launch itself passes through."""
        if heartbeat.mode not in self._modes or _is_after(heartbeat, self._offboard_accepted):
            return False
        if heartbeat.mode is FlightMode.TAKEOFF:
            self._takeoff = heartbeat
        if heartbeat.mode in (FlightMode.TAKEOFF, FlightMode.OFFBOARD):
            return True
        is_at_top = height_m is not None and height_m >= self.altitude_m - TOP_M
        return is_at_top or not _is_after(heartbeat, self._takeoff)

    @property
    def wants_stream(self) -> bool:
        """True if "stay here" setpoints are due: PX4 needs them before offboard."""
        return self.is_at_offboard and self._needs_prestream

    def tick(self, view: LaunchView) -> list[Command]:
        """Return the requests that are due now."""
        self._seen_s = view.now_s
        match self.stage:
            case Stage.READY:
                return self._when_ready(view)
            case Stage.MODE | Stage.ARM | Stage.TAKE_OFF:
                return self._ask(view)
            case Stage.CLIMB:
                self._when_climbed(view)
            case Stage.PRESTREAM:
                if not self._needs_prestream or view.now_s - self._since_s >= PRESTREAM_S:
                    self._enter(Stage.OFFBOARD, view.now_s)
            case Stage.OFFBOARD:
                return self._ask(view)
        return []

    def note_problem(self, what: str, now_s: float) -> None:
        """Report a problem: on the ground the launch waits for its end, later it is aborted."""
        self._seen_s = now_s
        if self.has_asked or now_s - self._since_s > READY_TIMEOUT_S:
            self.failure = what

    def wait(self, now_s: float) -> None:
        """Wait while the vehicle's state is unknown, for `BLIND_S` at most."""
        if now_s - self._seen_s > BLIND_S:
            self.failure = f"no link, mode or fresh position for {BLIND_S:g} s"

    def note_answer(self, event: RequestAnswered) -> None:
        """Process the autopilot's answer to the latest request."""
        kind, following = REQUESTS.get(self.stage, (None, self.stage))
        if event.kind is not kind:
            return
        what = f"{self.stage.value}: {event.outcome.value} {event.detail}".strip()
        if event.outcome is Outcome.ACCEPTED:
            if self.stage is Stage.OFFBOARD:
                self._offboard_accepted = event
                return
            if self.stage is Stage.TAKE_OFF:
                self._takeoff = event
            self._enter(following, event.time_s)
        elif (
            self.stage is Stage.TAKE_OFF
            and event.outcome is Outcome.REJECTED
            and (event.is_repeated or self._unanswered > 0)
        ):  # a lost answer to an earlier request, and a refusal because the take-off has begun
            self._refused = what
            self._enter(Stage.CLIMB, event.time_s)
        elif self._may_ask_again(event):
            self._is_asked = False
            self._retry_s = event.time_s + ARM_RETRY_S
        else:
            self.failure = what

    def _may_ask_again(self, event: RequestAnswered) -> bool:
        """Return True if the autopilot may still become ready, or the answer may have been lost."""
        if self.stage is Stage.ARM:
            return event.time_s - self._since_s < READY_TIMEOUT_S
        self._unanswered += 1
        return event.outcome is Outcome.NO_ANSWER and self._unanswered <= UNANSWERED_LIMIT

    def _enter(self, stage: Stage, now_s: float) -> None:
        self.stage = stage
        self._unanswered = 0
        self._since_s = now_s
        self._retry_s = now_s
        self._is_asked = False

    def _when_ready(self, view: LaunchView) -> list[Command]:
        heartbeat = view.heartbeat
        if heartbeat.autopilot is Autopilot.OTHER:
            self.failure = "only PX4 and ArduPilot can be launched"
        elif heartbeat.is_armed:
            name = mode_text(heartbeat)
            self.failure = f"the vehicle is already flying, in {name}"
        if self.failure is not None:
            return []
        self._needs_prestream = heartbeat.autopilot is not Autopilot.ARDUPILOT
        self._modes = PX4_MODES if self._needs_prestream else frozenset({FlightMode.OFFBOARD})
        if heartbeat.is_ready and view.has_origin:
            self._enter(Stage.MODE if self._launch_mode(heartbeat) else Stage.ARM, view.now_s)
        elif view.now_s - self._since_s > READY_TIMEOUT_S:
            self.failure = "the autopilot is not ready to arm"
        return []

    @staticmethod
    def _launch_mode(heartbeat: HeartbeatReceived) -> FlightMode | None:
        """Return the mode to arm in; None if the current one suffices."""
        if heartbeat.autopilot is Autopilot.ARDUPILOT:
            return None if heartbeat.mode is FlightMode.OFFBOARD else FlightMode.OFFBOARD
        usable = (FlightMode.HOLD, FlightMode.TAKEOFF)
        return None if heartbeat.mode in usable else FlightMode.HOLD

    def _ask(self, view: LaunchView) -> list[Command]:
        if self._is_asked:
            accepted = self._offboard_accepted
            if accepted is not None and view.now_s - accepted.time_s > MODE_TIMEOUT_S:
                name = mode_name(FlightMode.OFFBOARD, view.heartbeat.autopilot)
                if view.heartbeat.mode is FlightMode.OFFBOARD:
                    self.failure = f"{name} was entered, but control waits for its inputs"
                else:
                    self.failure = f"{name} was accepted but never entered"
            return []
        if view.now_s < self._retry_s:
            return []
        if self.stage is Stage.MODE:
            mode = self._launch_mode(view.heartbeat)
            if mode is None:
                self._enter(Stage.ARM, view.now_s)
            else:
                self._is_asked = True
                return [SetMode(mode, view.heartbeat.is_armed)]
        self._is_asked = True
        match self.stage:
            case Stage.ARM:
                return [Arm()]
            case Stage.TAKE_OFF:
                return [TakeOff(self.altitude_m, view.home_up_m)]
        return [SetMode(FlightMode.OFFBOARD, view.heartbeat.is_armed)]

    def _when_climbed(self, view: LaunchView) -> None:
        if view.height_m >= LIFTED_M:
            self._refused = None
        if view.height_m >= CLIMBED_SHARE * self.altitude_m:
            self._enter(Stage.PRESTREAM, view.now_s)
        elif self._refused is not None and view.now_s - self._since_s > LIFT_S:
            self.failure = self._refused
        elif view.now_s - self._since_s > CLIMB_TIMEOUT_S:
            self.failure = "the vehicle did not reach its altitude"


def _is_after(
    heartbeat: HeartbeatReceived, earlier: RequestAnswered | HeartbeatReceived | None
) -> bool:
    """Return True if a heartbeat was sent after an event; of unknown order, after a heartbeat."""
    if earlier is None:
        return False
    if earlier.order is None or heartbeat.order is None:
        return isinstance(earlier, HeartbeatReceived)
    return heartbeat.order > earlier.order
