"""Whether the vehicle may be launched by itself: only one that was found disarmed on the ground.

Theory of operation. Whoever armed a vehicle, or flies it, has it. So one look at an armed or flying
vehicle before the launch ends the permission for as long as this process lives, and the operator
engages as with `engage: operator`. An autopilot that does not tell whether it is on the ground is
waited for.
"""

from __future__ import annotations

from companion.domain import LandedState
from companion.guidance.commands import Severity
from companion.guidance.situation import Situation

FLIES = frozenset({LandedState.IN_AIR, LandedState.TAKEOFF, LandedState.LANDING})
PATIENCE_S = 10.0
"""How long the autopilot may keep silent about the ground before that is told."""


class LaunchPermit:
    """Looks at the vehicle before it is launched.

    Args:
        situation: Of the session.
    """

    def __init__(self, situation: Situation) -> None:
        self._situation = situation
        self._silent_since_s: float | None = None
        self._is_silence_told = False

    @property
    def is_wanted(self) -> bool:
        """Whether the vehicle is to be launched by itself, and nothing forbade it."""
        situation = self._situation
        return situation.params.engage == "auto" and not situation.has_launched

    @property
    def is_given(self) -> bool:
        """Whether the launch may begin now."""
        vehicle = self._situation.vehicle
        is_down = vehicle.landed is LandedState.ON_GROUND and not vehicle.is_armed
        return self.is_wanted and is_down

    def tick(self, now_s: float) -> None:
        """Look, while waiting and in standby."""
        situation, vehicle = self._situation, self._situation.vehicle
        if not self.is_wanted:
            return
        if vehicle.is_armed or vehicle.landed in FLIES:
            situation.has_launched = True
            found = "armed" if vehicle.is_armed else "in the air"
            text = f"not launching by itself: the vehicle was found {found}"
            situation.announce(Severity.WARNING, f"{text}; give {vehicle.guided_name} to engage")
        elif vehicle.landed is LandedState.UNKNOWN and vehicle.is_usable(now_s):
            self._wait_for_the_ground(now_s)
        else:
            self._silent_since_s = None

    def _wait_for_the_ground(self, now_s: float) -> None:
        if self._silent_since_s is None:
            self._silent_since_s = now_s
        if now_s - self._silent_since_s < PATIENCE_S or self._is_silence_told:
            return
        self._is_silence_told = True
        text = "not launching by itself: the autopilot does not tell that it is on the ground"
        self._situation.announce(Severity.WARNING, text)
