"""I1 and I4: setpoints and the paths to them stay inside the fence, and each could be the last.

A jump of the vehicle's own position is an error of the autopilot's, or the end of one; without the
true position the two cannot be distinguished. So for two seconds the new position may not be used
for guidance; if it is outside of fence or altitude band, the vehicle may not move at all: the path
back inside may lead outside.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from companion.domain import FlightMode, PositionEnu
from companion.mav.dialect import POSITION_AND_YAW, POSITION_ONLY, mavlink
from sim_link.lab.monitor.independent_checks import FENCE, INWARDS_M, SETPOINTS, Point
from sim_link.lab.monitor.scene import Invariant, SentSetpoint, TrueScene
from sim_link.lab.observer import Frame
from sim_link.world.point_mass import PointMass, approach_velocity

STEADY_S = 2.0
BLIND_S = 0.9
"""Reports farther apart than this cannot be compared, so a jump between them cannot be seen."""


class OwnJumps:
    """Follows the error of the autopilot's position."""

    def __init__(self, scene: TrueScene) -> None:
        self._scene = scene
        self._bias = scene.vehicle.estimator.bias_enu_m
        self._seemed: PositionEnu | None = None
        """Apparent vehicle position after the jump; None if there was none."""
        self._jumped_m = 0.0
        self._jumped_s = 0.0
        self._is_reported = False

    def stepped(self) -> None:
        """Handle a physics step, in which the vehicle's error may change."""
        scene, bias = self._scene, self._scene.vehicle.estimator.bias_enu_m
        before, self._bias = self._bias, bias
        if bias != before and math.dist(bias, before) > INWARDS_M:
            (e, n, u), (be, bn, bu) = scene.vehicle.body.position_enu_m, bias
            self._seemed, self._jumped_m = (e + be, n + bn, u + bu), math.dist(bias, before)
            self._jumped_s, self._is_reported = scene.now_s, False
        if self._seemed is not None and self._is_over():
            self._seemed = None

    def chased_m(self, setpoint: SentSetpoint) -> float | None:
        """Return a setpoint's distance from the apparent vehicle position, m; None: it is free."""
        observed = self._scene.observed.position_enu_m
        if self._seemed is None or observed is None or self._scene.is_lied_to:
            return None
        self._is_reported |= math.dist(observed, self._seemed) < 0.5 * self._jumped_m
        away_m = math.dist(setpoint.position_enu_m, self._seemed)
        return away_m if self._is_reported and away_m > self._scene.rules.step_m else None

    def _is_over(self) -> bool:
        """Return True if the companion may fly again, does not fly, or could not see the jump."""
        scene, observed = self._scene, self._scene.observed
        if not observed.is_ours or not scene.is_companion_up or observed.position_s is None:
            return True
        if not self._is_reported and scene.now_s - observed.position_s > BLIND_S:
            return True
        if self._seemed is None or scene.now_s - self._jumped_s <= STEADY_S:
            return False
        height_m = self._seemed[2] - scene.vehicle.home_enu_m[2]
        is_in_band = scene.rules.altitude_min_m <= height_m <= scene.rules.altitude_max_m
        return is_in_band and scene.depth_m(self._seemed[:2]) >= 0.0


HEIGHT_ROUNDING_M = 0.05
"""Rounding of heights: home and height are reported in millimetres and by a noisy estimate."""
CONTROL_FADES_S = 5.0
"""Time after control for which the companion is responsible for the vehicle's position, and before
it for which motion may be left over."""
OUR_MOTION = frozenset({FlightMode.OFFBOARD, FlightMode.HOLD, FlightMode.LAND})
"""Modes that fly our setpoints, or brake the motion that these began."""
FREEZE_EVERY_S = 2.0
FREEZE_FOR_S = 60.0
FREEZE_STEP_S = 0.1
KEPT_S = 2.5
"""Time after a jump of the vehicle position in which the setpoint does not move."""
SAFE_M = 1.0
"""Depth inside that need not be known more exactly."""
AT_REST_MPS, ARRIVED_M = 0.05, 0.2


class SetpointsInside(Invariant):
    """Setpoints and the paths to them are inside the fence."""

    name = "I1"
    title = "setpoints, the ways to them and the vehicle stay inside fence and altitude band"
    _anchor: Point | None = None
    """Position of the current or last setpoint."""
    _near_s = -math.inf
    """Time when the vehicle was reported beyond the border, or nearly there."""

    def setpoint(self, setpoint: SentSetpoint) -> None:
        """Judge a setpoint by the vehicle position that the companion knew.

        Without control it repeats the vehicle position; an unknown peer's position is not judged.
        """
        self._judge_height(setpoint.position_enu_m[2])
        if not self.scene.is_lied_to or self.scene.observed.is_ours:
            self._judge_borders(setpoint)

    def _judge_borders(self, setpoint: SentSetpoint) -> None:
        rules, observed = self.scene.rules, self.scene.observed
        position = setpoint.position_enu_m[:2]
        depth = self.scene.depth_m(position)
        least = rules.clearance_m - setpoint.rounding_m
        vehicle = None if self.scene.is_lied_to else observed.position_enu_m
        own_depth = math.inf if vehicle is None else self.scene.depth_m(vehicle[:2])
        anchor = self._anchor
        is_still = anchor is not None and math.dist(position, anchor) <= setpoint.rounding_m
        self._anchor = anchor if is_still else position
        is_no_farther = depth >= min(own_depth, rules.clearance_m) - setpoint.rounding_m
        if own_depth < rules.clearance_m:
            self._near_s = setpoint.time_s
        is_kept = is_still and setpoint.time_s - self._near_s <= KEPT_S
        if depth < least and not is_no_farther and not is_kept:
            self.report("setpoint too near to a border or beyond it", depth_m=depth)
        is_inside = vehicle is not None and own_depth > 0.0 and depth > 0.0
        if vehicle is not None and is_inside and not self.scene.is_way_clear(vehicle[:2], position):
            self.report("the way to a setpoint leaves the fence", depth_m=depth)

    def _judge_height(self, up_m: float) -> None:
        rules, home_m = self.scene.rules, self.scene.home_up_m
        if home_m is None:
            return
        height, error_m = up_m - home_m, self.scene.height_error_m
        if height < rules.altitude_min_m - HEIGHT_ROUNDING_M - error_m:
            self.report("setpoint below the altitude band", height_m=height)
        if height > rules.altitude_max_m + HEIGHT_ROUNDING_M + error_m:
            self.report("setpoint above the altitude band", height_m=height)


class InsideFence(SetpointsInside):
    """Setpoint, path to it and stopping point are inside the fence, and so is the true vehicle."""

    def __init__(self, scene: TrueScene) -> None:
        super().__init__(scene)
        self._truth = scene
        self._jumps = OwnJumps(scene)
        self.closest_m = math.inf
        """Smallest true distance to a border while the companion answered for it."""
        self.breaches = 0
        """Number of times that the true vehicle left the fence."""
        self._is_out = False
        self._in_control_s = -math.inf
        self._reached = 0
        """Number of our setpoints that reached the vehicle since the last step."""
        self._taken = 0
        """Number of setpoints that the vehicle accepted from any sender since boot."""
        self._is_dragged = False
        """True if it flies to a setpoint of another source."""
        self._dragged_s = -math.inf
        self._given_s = -math.inf
        """Time of the last hand-over."""
        self._mode = FlightMode.OFFBOARD
        self._is_taken_on = False
        """True if it also left the mode that it was in first after it was ours."""
        self._has_yielded = False
        """True if it reported another source in control, whatever mode is shown; I3 checks that."""
        self._has_left = False
        """True once the vehicle left the mode: until then it flies our last setpoint."""
        self._known: tuple[Point, float] = ((0.0, 0.0), -math.inf)
        """Position whose depth inside is known, and that depth."""
        self._fences = 0
        """Number of fences that the autopilot has had in force."""
        self._is_caught = False
        """True if fence or control came when the vehicle could not stop inside any more."""

    def setpoint(self, setpoint: SentSetpoint) -> None:
        """Check it against the true state, too."""
        super().setpoint(setpoint)
        chased_m = self._jumps.chased_m(setpoint)
        if chased_m is not None:
            self.report("a setpoint flies by a position that jumped", away_m=chased_m)

    def noted(self, kind: str, fields: Mapping[str, object]) -> None:
        """Follow whether it claims control."""
        if kind == "phase":
            self._has_yielded, self._has_left = fields.get("new") == "yield", False

    def started(self) -> None:
        """Forget yields at the start of a process."""
        self._has_yielded = self._has_left = False

    def reached(self, frame: Frame) -> None:
        """Handle a frame of the companion that reached the vehicle."""
        self._reached += frame.number in SETPOINTS and frame.is_readable

    def _watch_others(self, taken: int) -> None:
        """Note the sender of the last setpoint taken; another's counts until some time after.

        Motion for another sender is not the companion's doing; nor is the return from it; nor the
        drift with the wind of a vehicle that does not know its position any more.
        """
        new, self._taken = taken - self._taken, taken
        ours, self._reached = self._reached, 0
        if new > ours:
            self._is_dragged = True
        elif new > 0:
            self._is_dragged = False
        if self._is_dragged or not self._truth.vehicle.estimator.is_position_valid:
            self._dragged_s = self._truth.now_s

    @property
    def is_dragged(self) -> bool:
        """Return True if another source moved the vehicle shortly before, or the wind alone."""
        return self._truth.now_s - self._dragged_s < CONTROL_FADES_S

    @property
    def is_excused(self) -> bool:
        """Return True if the vehicle's motion is not the companion's doing."""
        return self.is_dragged or self._is_caught

    @property
    def is_moved_by_others(self) -> bool:
        """Return True if its motion is excused, or may be of before control was given."""
        return self.is_excused or self._truth.now_s - self._given_s < CONTROL_FADES_S

    def _watch_fences(self) -> None:
        """Excuse a vehicle that got fence or control too late to stop inside, until it can."""
        scene, body = self._truth, self._truth.vehicle.body
        before, self._fences = self._fences, len(scene.flown_fences)
        if before != self._fences:
            self._known = ((0.0, 0.0), -math.inf)
        is_of_others = not self._is_ours and scene.now_s - self._in_control_s > CONTROL_FADES_S
        if self._fences > before or self._is_caught or is_of_others:
            (east, north), (ve, vn) = body.position_enu_m[:2], body.velocity_enu_mps[:2]
            rules = scene.rules
            time_s = rules.latency_s + 0.5 * math.hypot(ve, vn) / rules.acceleration_mps2
            stop = (east + ve * time_s, north + vn * time_s)
            depth = min(scene.depth_m((east, north)), scene.depth_m(stop)) + scene.bias_m
            self._is_caught = depth < rules.clearance_m

    def _watch_mode(self) -> None:
        """Note the mode: the first after ours brakes our motion, others start a new one."""
        mode, before = self._truth.vehicle.flavour.mode, self._mode
        self._has_left |= self._has_yielded and mode is not FlightMode.OFFBOARD
        if mode is FlightMode.OFFBOARD and self._is_ours:
            self._is_taken_on = False
        elif mode is not before and before is not FlightMode.OFFBOARD:
            self._is_taken_on = True
        self._mode = mode

    @property
    def _is_ours(self) -> bool:
        return self._truth.observed.is_ours and not self._has_left

    def stepped(self) -> None:
        """Judge where the vehicle truly is and where it could stop."""
        self._jumps.stepped()
        scene, body = self._truth, self._truth.vehicle.body
        if not self._is_ours:
            self._given_s = scene.now_s
        elif scene.is_companion_up:
            self._in_control_s = scene.now_s
        if not scene.vehicle.is_armed:  # it falls, which no setpoint can change
            self._in_control_s = -math.inf
        self._watch_others(scene.vehicle.setpoints.received)
        self._watch_mode()
        self._watch_fences()
        is_flown_by_others = self._mode not in OUR_MOTION or self._is_taken_on
        is_flown_by_others |= self.is_excused
        has_faded = scene.now_s - self._in_control_s > CONTROL_FADES_S
        position = body.position_enu_m[:2]
        if body.is_on_ground or is_flown_by_others or has_faded:
            # another source may have taken it out
            self._is_out = not body.is_on_ground and scene.depth_m(position) + scene.bias_m < 0.0
            return
        at, known = self._known
        if known - math.dist(position, at) > max(0.0, self.closest_m):
            return  # it cannot have come nearer than it was
        depth = self.scene.depth_m(position) + scene.bias_m
        self._known = (position, depth)
        if self._is_out and depth < 0.0:
            return
        self.closest_m = min(self.closest_m, depth)
        self._is_out = depth < 0.0
        if self._is_out:
            self.breaches += 1
            self.report("the vehicle left the fence", depth_m=depth)


class PositionsOnly(Invariant):
    """No setpoint moves by itself."""

    name = "I4"
    title = "every setpoint may be the last one"

    def setpoint(self, setpoint: SentSetpoint) -> None:
        """Check the requested setpoint."""
        mask = getattr(setpoint.message, "type_mask", None)
        if mask not in (POSITION_ONLY, POSITION_AND_YAW):
            self.report("a setpoint that is not a position", mask=float(mask or 0))


class SafeToFreeze(PositionsOnly):
    """Freezing any setpoint for 60 s is safe, or stopping where another source moved it."""

    def __init__(self, scene: TrueScene, is_dragged: Callable[[], bool] = lambda: False) -> None:
        super().__init__(scene)
        self._is_dragged = is_dragged
        self._truth = scene
        self._frozen_s = -math.inf

    def setpoint(self, setpoint: SentSetpoint) -> None:
        """Fly on to it for a minute, from time to time.

        One that was given within the clearance may be taken out by a gust wherever it is held.
        """
        super().setpoint(setpoint)
        scene = self._truth
        if not scene.observed.is_ours or scene.now_s - self._frozen_s < FREEZE_EVERY_S:
            return
        self._frozen_s = scene.now_s
        bias = scene.vehicle.estimator.bias_enu_m
        east, north, up = setpoint.position_enu_m
        goal = (east - bias[0], north - bias[1], up - bias[2])
        body, rules = scene.vehicle.body, scene.rules
        own = self.scene.depth_m(body.position_enu_m[:2]) + scene.bias_m
        if 0.0 <= own < rules.clearance_m:
            if self.scene.depth_m(goal[:2]) + scene.bias_m < -setpoint.rounding_m:
                self.report("a setpoint that freezes leads out of the fence", depth_m=own)
            return
        if own < 0.0:  # on its way back: the position itself must not lie farther out
            depth, moved_m = scene.depth_m(goal[:2]), math.hypot(*body.velocity_enu_mps[:2])
            least_m = own - rules.clearance_m - moved_m * rules.latency_s
            if depth + scene.bias_m < least_m:
                self.report("a setpoint that freezes leads farther out", depth_m=depth)
            return
        least = self._least_depth(goal)
        if least + scene.bias_m >= 0.0:
            return
        if self._is_dragged():
            stopped = self._least_depth(body.position_enu_m)
            if least >= stopped - setpoint.rounding_m:
                return  # no farther than stopping at once does
        self.report("a setpoint that freezes leads out of the fence", depth_m=least)

    def _least_depth(self, goal: PositionEnu) -> float:
        truth = self._truth.vehicle.body
        params = self._truth.vehicle.scenario.vehicle
        body = PointMass(params, truth.wind, truth.position_enu_m, truth.ground_up_m)
        body.velocity_enu_mps = truth.velocity_enu_mps
        least, known, at = math.inf, -math.inf, (0.0, 0.0)
        for _ in range(round(FREEZE_FOR_S / FREEZE_STEP_S)):
            position = body.position_enu_m
            if known - math.dist(at, position[:2]) < max(0.0, min(least, SAFE_M)):
                known, at = self.scene.depth_m(position[:2]), position[:2]
                least = min(least, known)
            is_there = math.dist(position, goal) < ARRIVED_M
            if is_there and math.hypot(*body.velocity_enu_mps) < AT_REST_MPS:
                break
            body.step(approach_velocity(position, goal, params), None, FREEZE_STEP_S)
        return least


REACTION_S = 12.0
"""Longest time to a request for a changed fence: one without an id is read every 10 s."""
MISSION_CURRENT = mavlink.MAVLINK_MSG_ID_MISSION_CURRENT


class FenceIsRead(Invariant):
    """In control, a fence that another station uploads is requested.

    Not judged: a companion whose last request was not answered, because it pauses before the next
    one, and on PX4 the time before a MISSION_CURRENT with the fence's new id is heard.
    """

    name = "I1"
    title = SetpointsInside.title

    def __init__(self, scene: TrueScene) -> None:
        super().__init__(scene)
        self._truth = scene
        self._fence: object = scene.vehicle.aircraft.fence
        self._since_s: float | None = None
        """Earliest time at which it could know of another fence; None: all were requested."""
        self._is_shown = not scene.is_px4
        self._asked_s = -math.inf

    def started(self) -> None:
        """A new process reads it before it takes control."""
        self._since_s, self._asked_s = None, -math.inf

    def heard(self, frame: Frame) -> None:
        """PX4 shows a change by an id."""
        if self._since_s is not None and not self._is_shown and frame.number == MISSION_CURRENT:
            self._is_shown, self._since_s = True, self.scene.now_s

    def sent(self, frame: Frame) -> None:
        """Note that it requests the fence."""
        message = frame.message
        is_list = isinstance(message, mavlink.MAVLink_mission_request_list_message)
        if is_list and getattr(message, "mission_type", None) == FENCE:
            self._since_s, self._asked_s = None, self.scene.now_s

    def stepped(self) -> None:
        """Check the time for which a changed fence was not requested."""
        scene, now_s = self._truth, self._truth.now_s
        before, self._fence = self._fence, scene.vehicle.aircraft.fence
        was_answered = scene.in_force.read_s >= self._asked_s
        if before is not self._fence and was_answered and scene.rules.keeps_autopilot_fence:
            self._since_s, self._is_shown = now_s, not scene.is_px4
        is_able = scene.observed.is_ours and scene.is_companion_up and not scene.is_lied_to
        if not is_able or scene.suspended_until_s >= now_s:
            self._since_s = None
        if self._since_s is not None and self._is_shown and now_s - self._since_s > REACTION_S:
            self._since_s = None
            self.report("a fence of another station is not requested")
