"""Arming and flight modes of PX4: the rules, and nothing else.

Theory of operation. Two modes are kept apart, as in PX4's commander: the *intention*, which an
operator chose, and the *mode* that is flown. They differ only during a failsafe: the mode is the
reaction, the intention is what it was. When the failsafe ends by itself (setpoints return), the
intention is flown again without any command; when the operator chooses a mode meanwhile, that
choice replaces the intention and ends the failsafe.

    event                               | condition                 | result
    ------------------------------------+---------------------------+------------------------------
    choose HOLD, TAKEOFF, LAND, RETURN  | any                       | flown
    choose OFFBOARD                     | disarmed, or stream alive | flown
                                        | armed, no stream          | temporarily rejected
    choose MISSION                      | disarmed, or one is there | flown
                                        | armed, no mission         | temporarily rejected
    choose a mode for sticks            | disarmed, or sticks       | flown
                                        | armed, no sticks          | temporarily rejected
    choose READY, or no mode of PX4's   | any                       | denied
    arm                                 | armed                     | accepted, nothing happens
                                        | checks passed; HOLD,      | armed
                                        | TAKEOFF, a mode for sticks|
                                        | with sticks, or           |
                                        | OFFBOARD with a stream    |
                                        | otherwise, forced or not  | temporarily rejected
    disarm                              | on the ground, or forced  | disarmed
                                        | in the air                | temporarily rejected
    takeoff height reached              | TAKEOFF                   | HOLD
    mission complete                    | MISSION                   | HOLD

Disarming ends LAND, RETURN, TAKEOFF, MISSION and a failsafe in HOLD, so that the next flight can be
armed.

Source: PX4 1.15 as observed in SITL; where it accepts nonsense, this is stricter.
"""

from __future__ import annotations

from dataclasses import dataclass

from companion.domain import FlightMode
from sim_link.autopilot.commands import ACCEPTED, DENIED, TEMPORARILY_REJECTED

AUTOMATIC_MODES = frozenset(
    {FlightMode.HOLD, FlightMode.TAKEOFF, FlightMode.LAND, FlightMode.RETURN}
)
STICK_MODES = frozenset(
    {
        FlightMode.POSITION,
        FlightMode.ALTITUDE,
        FlightMode.STABILIZED,
        FlightMode.ACRO,
        FlightMode.MANUAL,
    }
)
ENDED_BY_DISARMING = AUTOMATIC_MODES | {FlightMode.MISSION}
MODE_NAMES: dict[FlightMode, str] = {
    FlightMode.HOLD: "Hold",
    FlightMode.TAKEOFF: "Takeoff",
    FlightMode.LAND: "Land",
    FlightMode.RETURN: "Return",
    FlightMode.MISSION: "Mission",
    FlightMode.OFFBOARD: "Offboard",
    FlightMode.POSITION: "Position",
    FlightMode.ALTITUDE: "Altitude",
    FlightMode.STABILIZED: "Stabilized",
    FlightMode.ACRO: "Acro",
    FlightMode.MANUAL: "Manual",
}
"""As PX4 and QGroundControl call them."""


@dataclass(frozen=True, slots=True)
class Situation:
    """What the rules need to know of the vehicle at one moment."""

    check_refusal: str | None
    """Why the checks that hold in every mode fail; None: they pass."""
    is_stream_alive: bool
    is_on_ground: bool
    has_sticks: bool
    has_mission: bool


class ModeLogic:
    """Who may arm, and which mode is flown."""

    def __init__(self) -> None:
        self.intention = FlightMode.HOLD
        """The mode that the operator chose."""
        self.reaction: FlightMode | None = None
        """The mode that a failsafe puts in its place."""
        self.is_armed = False

    @property
    def mode(self) -> FlightMode:
        """The mode that is flown and shown in HEARTBEAT."""
        return self.intention if self.reaction is None else self.reaction

    @property
    def is_failsafe(self) -> bool:
        """Whether a failsafe chose the mode that is flown."""
        return self.is_armed and self.reaction is not None

    def arming_refusal(self, situation: Situation) -> str | None:
        """Why a request to arm would be refused now, or None."""
        if situation.check_refusal is not None:
            return situation.check_refusal
        mode = self.mode
        if mode is FlightMode.OFFBOARD:
            return None if situation.is_stream_alive else "no offboard setpoints"
        if mode in STICK_MODES:
            return None if situation.has_sticks else "no manual control"
        if mode in (FlightMode.HOLD, FlightMode.TAKEOFF):
            return None
        return f"{MODE_NAMES[mode]} mode cannot be armed in"

    def choice_refusal(self, mode: FlightMode, situation: Situation) -> str | None:
        """Why an armed vehicle would not be switched to a mode now, or None."""
        if mode is FlightMode.OFFBOARD and not situation.is_stream_alive:
            return "no setpoints"
        if mode is FlightMode.MISSION and not situation.has_mission:
            return "no mission"
        if mode in STICK_MODES and not situation.has_sticks:
            return "no manual control"
        return None

    def choose(self, mode: FlightMode | None, situation: Situation) -> int:
        """The operator's choice of a mode (None: PX4 has no such mode); a MAV_RESULT."""
        if mode is None or mode in (FlightMode.READY, FlightMode.UNKNOWN):
            return DENIED
        if self.is_armed and self.choice_refusal(mode, situation) is not None:
            return TEMPORARILY_REJECTED
        self.intention = mode
        self.reaction = None
        return ACCEPTED

    def arm(self, situation: Situation) -> int:
        """A request to arm, forced or not; a MAV_RESULT."""
        if self.is_armed:
            return ACCEPTED
        if self.arming_refusal(situation) is not None:
            return TEMPORARILY_REJECTED
        self.is_armed = True
        return ACCEPTED

    def disarm(self, situation: Situation, *, is_forced: bool) -> int:
        """A request to disarm; forced, it stops the motors in the air. A MAV_RESULT."""
        if not self.is_armed:
            return ACCEPTED
        if not situation.is_on_ground and not is_forced:
            return TEMPORARILY_REJECTED
        if self.is_failsafe or self.mode in ENDED_BY_DISARMING:
            self.intention = FlightMode.HOLD
        self.reaction = None
        self.is_armed = False
        return ACCEPTED

    def finish(self, mode: FlightMode) -> None:
        """TAKEOFF has reached its height, or MISSION its end: stay there."""
        if self.intention is mode:
            self.intention = FlightMode.HOLD
