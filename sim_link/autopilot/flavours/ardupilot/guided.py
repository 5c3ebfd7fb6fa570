"""GUIDED: take-off first, positions latched for ever, motions that time out without a word.

Source: ArduCopter 4.5 as observed in SITL; parameter GUID_TIMEOUT.
"""

from __future__ import annotations

from enum import Enum

from companion.domain import PositionEnu
from sim_link.autopilot.echo import NOTHING, Axes, Echo
from sim_link.autopilot.flavours.ardupilot.setpoints import Target, TargetKind
from sim_link.autopilot.pilot import Task
from sim_link.autopilot.setpoints import Setpoint

STILL: PositionEnu = (0.0, 0.0, 0.0)


class GuidedState(Enum):
    """What GUIDED is at."""

    IDLE = "idle"
    """In place, in the air or on the ground."""
    CLIMBING = "climbing"
    FOLLOWING = "following"


class Guided:
    """The state of GUIDED; it begins anew whenever the mode is entered."""

    def __init__(self) -> None:
        self.state = GuidedState.IDLE
        self.setpoint = Setpoint()
        self._kind = TargetKind.STOP
        self._taken_s = 0.0

    @property
    def task(self) -> Task:
        """What the pilot is to do."""
        match self.state:
            case GuidedState.CLIMBING:
                return Task.TAKE_OFF
            case GuidedState.FOLLOWING:
                return Task.FOLLOW
        return Task.STAY

    @property
    def is_latched(self) -> bool:
        """Whether it flies to a position and stays there for ever."""
        return self.state is GuidedState.FOLLOWING and self._kind is TargetKind.POSITION

    def echo(self, climb_goal_enu_m: PositionEnu | None) -> Echo:
        """What POSITION_TARGET_* tells: a place, or a motion, which is 0 while it stays.

        Args:
            climb_goal_enu_m: Where a take-off goes.
        """
        if self.state is GuidedState.CLIMBING and climb_goal_enu_m is not None:
            return Echo(climb_goal_enu_m)
        if self.state is not GuidedState.FOLLOWING:
            return Echo(NOTHING, STILL, STILL)
        setpoint = self.setpoint
        place: Axes = (*(setpoint.position_en_m or (None, None)), setpoint.up_m)
        if setpoint.velocity_en_mps is None:
            return Echo(place, NOTHING, setpoint.acceleration_enu_mps2 or NOTHING)
        velocity = (*setpoint.velocity_en_mps, setpoint.climb_mps or 0.0)
        return Echo(place, velocity, setpoint.acceleration_enu_mps2 or STILL)

    def enter(self) -> None:
        """The mode begins: stay until something is asked."""
        self.stop()

    def stop(self) -> None:
        """Stay in place."""
        self.state = GuidedState.IDLE
        self.setpoint = Setpoint()
        self._kind = TargetKind.STOP

    def take_off(self) -> None:
        """Climb, until the height is reached or a target takes over."""
        self.state = GuidedState.CLIMBING
        self.setpoint = Setpoint()

    def take(self, target: Target, now_s: float, *, is_on_ground: bool) -> None:
        """A target arrived; on the ground it has no effect, because a take-off comes first."""
        if is_on_ground:
            return
        if target.kind is TargetKind.STOP:
            self.stop()
            return
        self.state = GuidedState.FOLLOWING
        self.setpoint = target.setpoint
        self._kind = target.kind
        self._taken_s = now_s

    def watch(self, now_s: float, timeout_s: float, *, is_on_ground: bool) -> None:
        """Let a motion time out, and a target end on the ground."""
        if self.state is not GuidedState.FOLLOWING:
            return
        is_old = self._kind is TargetKind.MOTION and now_s - self._taken_s >= timeout_s
        if is_old or is_on_ground:
            self.stop()
