"""Arming, flight modes and the offboard failsafe: the rules, and nothing else.

Theory of operation. Two modes are kept apart, as in PX4's commander: the *intention*, which an
operator chose, and the *mode* that is flown. They differ only during the offboard failsafe: the
intention is still OFFBOARD, the mode is the configured reaction. When setpoints return, the
intention is flown again without any command; when the operator chooses a mode meanwhile, that
choice replaces the intention and ends the failsafe.

    event                               | condition                 | result
    ------------------------------------+---------------------------+------------------------------
    choose HOLD, TAKEOFF, LAND, RETURN  | any                       | flown
    choose OFFBOARD                     | disarmed, or stream alive | flown
                                        | armed, no stream          | temporarily rejected
    choose a mode for sticks or mission | disarmed                  | shown, cannot be armed
                                        | armed                     | temporarily rejected
    choose READY, or no mode of PX4's   | any                       | denied
    arm                                 | armed                     | accepted, nothing happens
                                        | booted; HOLD, TAKEOFF, or | armed
                                        | OFFBOARD with a stream    |
                                        | otherwise, forced or not  | temporarily rejected
    disarm                              | on the ground, or forced  | disarmed
                                        | in the air                | temporarily rejected
    stream lost                         | armed in OFFBOARD         | failsafe
    stream returns                      | failsafe                  | OFFBOARD
    takeoff height reached              | TAKEOFF                   | HOLD

Disarming ends LAND, RETURN, TAKEOFF and a failsafe in HOLD, so that the next flight can be armed.

Source: PX4 1.15 as observed in SITL; where it accepts nonsense, this is stricter.
"""

from __future__ import annotations

from dataclasses import dataclass

from companion.domain import FlightMode
from companion.mav.dialect import mavlink
from sim_link.autopilot.scenario import LossAction

ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
TEMPORARILY_REJECTED = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
DENIED = mavlink.MAV_RESULT_DENIED

AUTOMATIC_MODES = frozenset(
    {FlightMode.HOLD, FlightMode.TAKEOFF, FlightMode.LAND, FlightMode.RETURN}
)
ARMABLE_MODES = frozenset({FlightMode.HOLD, FlightMode.TAKEOFF, FlightMode.OFFBOARD})
ENDED_BY_DISARMING = frozenset({FlightMode.LAND, FlightMode.RETURN, FlightMode.TAKEOFF})
MODE_OF_LOSS_ACTION: dict[LossAction, FlightMode] = {
    "hold": FlightMode.HOLD,
    "position": FlightMode.POSITION,
    "return": FlightMode.RETURN,
    "land": FlightMode.LAND,
}


@dataclass(frozen=True, slots=True)
class Situation:
    """What the rules need to know of the vehicle at one moment."""

    is_booted: bool
    """The estimator has settled: arming is possible."""
    is_stream_alive: bool
    is_on_ground: bool


class ModeLogic:
    """Who may arm, which mode is flown, and the offboard failsafe.

    Args:
        loss_action: What OFFBOARD becomes when its setpoints stop.
    """

    def __init__(self, loss_action: LossAction) -> None:
        self._loss_mode = MODE_OF_LOSS_ACTION[loss_action]
        self.mode = FlightMode.HOLD
        """The mode that is flown and shown in HEARTBEAT."""
        self.intention = FlightMode.HOLD
        """The mode that the operator chose."""
        self.is_armed = False

    @property
    def is_failsafe(self) -> bool:
        """Whether the flown mode is the reaction to lost setpoints."""
        return self.is_armed and self.mode is not self.intention

    def can_arm(self, situation: Situation) -> bool:
        """Whether a request to arm would be accepted now."""
        if not situation.is_booted or self.mode not in ARMABLE_MODES:
            return False
        return self.mode is not FlightMode.OFFBOARD or situation.is_stream_alive

    def choose(self, mode: FlightMode | None, situation: Situation) -> int:
        """The operator's choice of a mode (None: PX4 has no such mode); a MAV_RESULT."""
        if mode is None or mode in (FlightMode.READY, FlightMode.UNKNOWN):
            return DENIED
        if self.is_armed and mode not in AUTOMATIC_MODES:
            is_possible = mode is FlightMode.OFFBOARD and situation.is_stream_alive
            if not is_possible:
                return TEMPORARILY_REJECTED
        self.mode = self.intention = mode
        return ACCEPTED

    def arm(self, situation: Situation) -> int:
        """A request to arm, forced or not; a MAV_RESULT."""
        if self.is_armed:
            return ACCEPTED
        if not self.can_arm(situation):
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
            self.mode = FlightMode.HOLD
        self.intention = self.mode
        self.is_armed = False
        return ACCEPTED

    def watch_stream(self, situation: Situation) -> None:
        """Enter and leave the offboard failsafe."""
        if not self.is_armed or self.intention is not FlightMode.OFFBOARD:
            return
        if situation.is_stream_alive:
            self.mode = FlightMode.OFFBOARD
        elif self.mode is FlightMode.OFFBOARD:
            self.mode = self._loss_mode

    def finish_takeoff(self) -> None:
        """The takeoff height is reached."""
        if self.mode is FlightMode.TAKEOFF:
            self.mode = self.intention = FlightMode.HOLD
