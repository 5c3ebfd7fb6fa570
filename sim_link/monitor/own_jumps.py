"""Whether a companion chases a vehicle's own position that jumped: a part of I1.

A jump is an error of the autopilot's, or the end of one; without the truth nobody can know which.
So for two seconds nothing may be flown by the new position, and if that lies outside of fence or
altitude band, nothing at all: the way back inside may be the way out.
"""

from __future__ import annotations

import math

from companion.domain import PositionEnu
from sim_link.monitor.predicates import INWARDS_M, depth_m
from sim_link.monitor.scene import Setpoint, TrueScene

STEADY_S = 2.0
BLIND_S = 0.9
"""Reports farther apart than this cannot be compared, so a jump between them cannot be seen."""


class OwnJumps:
    """Follows the error of the autopilot's position.

    Args:
        scene: With the truth.
    """

    def __init__(self, scene: TrueScene) -> None:
        self._scene = scene
        self._bias = scene.vehicle.estimator.bias_enu_m
        self._seemed: PositionEnu | None = None
        """Where the vehicle seemed to be after the jump; None: nothing jumped."""
        self._jumped_m = 0.0
        self._jumped_s = 0.0
        self._is_told = False

    def stepped(self) -> None:
        """The vehicle moved, and so may have its error."""
        scene, bias = self._scene, self._scene.vehicle.estimator.bias_enu_m
        before, self._bias = self._bias, bias
        if bias != before and math.dist(bias, before) > INWARDS_M:
            (e, n, u), (be, bn, bu) = scene.vehicle.body.position_enu_m, bias
            self._seemed, self._jumped_m = (e + be, n + bn, u + bu), math.dist(bias, before)
            self._jumped_s, self._is_told = scene.now_s, False
        if self._seemed is not None and self._is_over():
            self._seemed = None

    def chased_m(self, setpoint: Setpoint) -> float | None:
        """How far a setpoint is from where the vehicle seemed to be, if it must stay; else None."""
        told = self._scene.told.position_enu_m
        if self._seemed is None or told is None or self._scene.is_lied_to:
            return None
        self._is_told |= math.dist(told, self._seemed) < 0.5 * self._jumped_m
        away_m = math.dist(setpoint.place_enu_m, self._seemed)
        return away_m if self._is_told and away_m > self._scene.rules.step_m else None

    def _is_over(self) -> bool:
        """Whether the companion may fly again, does not, or could not see that anything jumped."""
        scene, told = self._scene, self._scene.told
        if not told.is_ours or not scene.is_companion_up or told.position_s is None:
            return True
        if not self._is_told and scene.now_s - told.position_s > BLIND_S:
            return True
        return scene.now_s - self._jumped_s > STEADY_S and self._seems_inside()

    def _seems_inside(self) -> bool:
        scene, rules = self._scene, self._scene.rules
        assert self._seemed is not None
        east, north, up = self._seemed
        height_m = up - scene.vehicle.home_enu_m[2]
        is_in_band = rules.altitude_min_m <= height_m <= rules.altitude_max_m
        return is_in_band and depth_m(rules.fence_enu_m, rules.keep_out_enu_m, (east, north)) >= 0.0
