"""Which fence the guard keeps: the configured one, once it is known to be the right one.

Theory of operation. A fence in local metres is there from the start. One in degrees (of a file, or
of the autopilot) becomes local when the autopilot's origin is known, again whenever that changes,
and its margin grows by what an autopilot's own frame may distort it by. Until then, and whenever
something speaks against it, the guard has no fence: nothing engages, and what flies holds.

A fence is a place in the world, in whatever way it is given. One in local metres lies about the
first origin that was heard, its anchor; when the origin moves, the fence is turned into the new
frame by the step between both. The anchor outlives restarts of the autopilot, and of the companion
in mid-mission.

Two fences that differ are worse than one: each protects from what the other allows. So the
autopilot's is compared, and a difference is refused.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import Enum

from companion.geometry.coordinates import LocalOrigin
from companion.geometry.geofence import DISTORTION, GeoFence, LocalFence, difference
from companion.geometry.polygons import Corners, Point
from companion.guard.fence import Fence
from companion.guard.gate import Guard, GuardLimits
from companion.guidance.events import AutopilotFenceRead

TOLERANCE_M = 1.0
"""How far apart two borders may be that are meant to be the same."""
FARTHEST_STEP_M = 1000.0
"""An origin that moved farther than this means another place, and not a better fix."""


class FencePolicy(Enum):
    """What the autopilot's own fence is for."""

    IGNORE = "ignore"
    """Nothing: it is not even read."""
    COMPARE = "compare"
    """It must be ours; having none, or not telling, is said and allowed."""
    REQUIRE = "require"
    """It must be ours, and there must be one."""
    USE = "use"


@dataclass(frozen=True, slots=True)
class FencePlan:
    """Where the guard's fence comes from."""

    limits: GuardLimits
    """With the fence if that is local."""
    margin_m: float
    keep_out_enu_m: tuple[Corners, ...] = ()
    """Keep-outs of our own, beside those of a fence in degrees."""
    site: GeoFence | None = None
    policy: FencePolicy = FencePolicy.IGNORE


class Fencing:
    """Gives the guard its fence and says why it has none; without a plan it has one already."""

    def __init__(self, guard: Guard, plan: FencePlan | None = None) -> None:
        local = FencePlan(guard.limits, 0.0)
        self.plan = local if plan is None else plan
        self.refusal: str | None = None
        """Why there is none though everything is known, in words."""
        self.note: str | None = None
        """What the operator should know of one that is there."""
        self.guard = guard
        self.anchor: LocalOrigin | None = None
        """The origin that local metres of the configuration are about; None: not heard yet."""
        self._origin: LocalOrigin | None = None
        self._read: AutopilotFenceRead | None = None
        self._settle()

    @property
    def is_ready(self) -> bool:
        """Whether the guard has its fence."""
        return self.refusal is None and not self.missing

    @property
    def missing(self) -> list[str]:
        """What is not there yet, in words."""
        plan, read = self.plan, self._read
        parts = {
            "the autopilot's fence": plan.policy is FencePolicy.IGNORE or read is not None,
            "the origin": self._origin is not None or not self._needs_origin,
        }
        return [name for name, is_there in parts.items() if not is_there]

    @property
    def words(self) -> str:
        """The fence in a few words."""
        fence = self.guard.limits.fence
        if fence is None:
            return "none"
        text = f"{len(fence.polygon_enu_m)} corners, {len(fence.keep_out_enu_m)} keep-outs"
        return f"{text}, margin {fence.margin_m:.1f} m"

    @property
    def site(self) -> GeoFence | None:
        """The fence in degrees, of a file or of the autopilot; None: none, or not known yet."""
        if self.plan.policy is not FencePolicy.USE:
            return self.plan.site
        return None if self._read is None else self._read.fence

    @property
    def is_site_known(self) -> bool:
        """Whether `site` is what it will be: the autopilot may not have told its fence yet."""
        return self.plan.policy is not FencePolicy.USE or self._read is not None

    @property
    def wants_reading(self) -> bool:
        """Whether the autopilot is to be asked for its fence, once more if it did not help."""
        if self.plan.policy is FencePolicy.IGNORE:
            return False
        return self._read is None or self._read.problem is not None or self.refusal is not None

    def set_origin(self, origin: LocalOrigin) -> None:
        """Take in the origin of the local frame; the first one is the anchor."""
        self._origin = origin
        if self.anchor is None:
            self.anchor = origin
        self._settle()

    def recall(self, anchor: LocalOrigin) -> None:
        """Take up the anchor of an earlier process: its fence is still in the same place."""
        self.anchor = anchor
        self._settle()

    def take(self, event: AutopilotFenceRead) -> None:
        """Take in the autopilot's fence."""
        self._read = event
        self._settle()

    def use_limits(self, limits: GuardLimits) -> None:
        """Other limits of motion from now on, with the same fence."""
        self.plan = replace(self.plan, limits=limits)
        self._settle()

    def forget(self) -> None:
        """The autopilot restarted: its origin and its fence are not known any more; ours stays."""
        self._origin = self._read = None
        self._settle()

    @property
    def _needs_origin(self) -> bool:
        has_one = self._read is not None and self._read.fence is not None
        return self.plan.site is not None or has_one or self.anchor is not None

    def _settle(self) -> None:
        self.refusal = self.note = None
        fence: Fence | None = None
        if not self.missing:
            try:
                fence = self._fence()
                self._compare()
            except ValueError as error:
                self.refusal = str(error)
        usable = fence if self.refusal is None else None
        self.guard.use(replace(self.plan.limits, fence=usable))

    def _fence(self) -> Fence | None:
        plan, site = self.plan, self.plan.site
        if plan.policy is FencePolicy.USE:
            site = self._autopilots()
            if site is None:
                raise ValueError("the autopilot has no fence to use")
        if site is None or self._origin is None:
            return self._local_fence(plan.limits.fence)
        local, step_m = site.local(self._origin), self._step_m()
        keep_outs = (*local.keep_out_enu_m, *_moved(plan.keep_out_enu_m, step_m))
        margin_m = plan.margin_m + local.distortion_m + DISTORTION * math.hypot(*step_m)
        return Fence(local.polygon_enu_m, margin_m, keep_outs)

    def _local_fence(self, fence: Fence | None) -> Fence | None:
        """The fence of the configuration in the present frame."""
        step_m = self._step_m()
        if fence is None or step_m == (0.0, 0.0):
            return fence
        polygon, *keep_outs = _moved((fence.polygon_enu_m, *fence.keep_out_enu_m), step_m)
        margin_m = fence.margin_m + DISTORTION * math.hypot(*step_m)
        return Fence(polygon, margin_m, tuple(keep_outs))

    def _step_m(self) -> Point:
        """Where the anchor is now, east and north; a `ValueError` where it is another place."""
        origin, anchor, plan = self._origin, self.anchor, self.plan
        is_local = plan.limits.fence is not None or bool(plan.keep_out_enu_m)
        if origin is None or anchor is None or origin == anchor or not is_local:
            return (0.0, 0.0)
        east_m, north_m, _ = origin.zero_of(anchor)
        away_m = math.hypot(east_m, north_m)
        if away_m > FARTHEST_STEP_M:
            raise ValueError(
                f"the autopilot's origin is {away_m / 1000.0:.1f} km from where it was; restart "
                "the companion to have the fence in local metres about the new one"
            )
        return (east_m, north_m)

    def _autopilots(self) -> GeoFence | None:
        """The autopilot's fence; None: it has none. A `ValueError` if it could not be read."""
        if self._read is None:
            return None
        if self._read.problem is not None:
            raise ValueError(f"the autopilot's fence: {self._read.problem}")
        return self._read.fence

    def _compare(self) -> None:
        """See that the autopilot's fence is ours; a `ValueError` if not, or if it must have one."""
        plan, read = self.plan, self._read
        if plan.policy not in (FencePolicy.COMPARE, FencePolicy.REQUIRE) or read is None:
            return
        is_unread = read.problem is not None and not read.is_unusable
        if plan.policy is FencePolicy.COMPARE and is_unread:
            self.note = f"the autopilot's fence is not compared: {read.problem}"
            return
        theirs = self._autopilots()
        if theirs is None:
            if plan.policy is FencePolicy.REQUIRE:
                raise ValueError("the autopilot has no fence, and limits.autopilot_fence wants one")
            self.note = "the autopilot has no fence of its own: only the guard keeps ours"
            return
        differs = self._difference(theirs)
        if differs is not None:
            raise ValueError(f"the autopilot's fence is another one: {differs}")

    def _difference(self, theirs: GeoFence) -> str | None:
        plan, fence = self.plan, self.plan.limits.fence
        if plan.site is not None:
            centre = plan.site.centre
            own, other = plan.site.local(centre), theirs.local(centre)
            return difference(own, other, TOLERANCE_M, plan.keep_out_enu_m)
        if fence is None or self.anchor is None:
            return None
        own, other = LocalFence(fence.polygon_enu_m), theirs.local(self.anchor)
        return difference(own, other, TOLERANCE_M + other.distortion_m, fence.keep_out_enu_m)


def _moved(polygons: Iterable[Corners], step_m: Point) -> list[Corners]:
    """The same places where the zero of the frame is elsewhere."""
    east_m, north_m = step_m
    return [tuple((e + east_m, n + north_m) for e, n in polygon) for polygon in polygons]
