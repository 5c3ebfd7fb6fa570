"""The guard's fence: the configured one, once it is confirmed against the autopilot's.

Theory of operation. A fence in local metres exists from the start. A fence in degrees (of a file,
or of the autopilot) is projected when the autopilot's origin is known, again whenever that changes,
and its margin grows by the largest distortion of an autopilot's own projection. Until then, and
whenever a check fails, the guard has no fence: control cannot begin, and a vehicle in flight holds.

A fence is fixed to the Earth, in whatever way it is given. A fence in local metres refers to the
first origin that was received, its anchor; when the origin moves, the fence is shifted into the new
frame by the step between both. The anchor and the autopilot's fences of a flight outlive restarts
of the autopilot, and of the companion in mid-mission.

Two fences that differ are worse than one: each forbids what the other allows. So the autopilot's
fence is compared, and a difference is refused.

Another station may upload another fence at any time. Until it is downloaded control cannot begin,
and a vehicle in flight holds inside the known fence. In the air the guard's fence only ever
shrinks: it is the intersection of all fences that the autopilot has had in this flight, in control
even where `compare` would refuse a difference. It is widened on the ground. A circle around home
counts as one of these fences when home moves.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import Enum

from companion.geometry.coordinates import LocalOrigin
from companion.geometry.geofence import (
    DISTORTION,
    GeoArea,
    GeoFence,
    LocalFence,
    circle_about,
    difference,
)
from companion.geometry.polygons import Corners, Point, area_m2
from companion.guard.gate import Guard, GuardLimits
from companion.guard.limits import Envelope, Fence
from companion.guidance.events import AutopilotFenceRead, FenceLimits

TOLERANCE_M = 1.0
"""Largest distance between two borders that are regarded as equal."""
MAX_STEP_M = 1000.0
"""Longest step of an origin that is a better fix; beyond it the origin is that of another site."""


class FencePolicy(Enum):
    """Use of the autopilot's own fence."""

    IGNORE = "ignore"
    """The autopilot's fence is not downloaded at all."""
    COMPARE = "compare"
    """The autopilot's fence must equal ours; a missing one is announced and allowed."""
    REQUIRE = "require"
    """The autopilot must have a fence, and it must equal ours."""
    USE = "use"


@dataclass(frozen=True, slots=True)
class FencePlan:
    """Sources of the guard's fence."""

    limits: GuardLimits
    """Limits, with the fence if that is local."""
    margin_m: float
    keep_out_enu_m: tuple[Corners, ...] = ()
    """Keep-outs of our own, in addition to those of a fence in degrees."""
    site: GeoFence | None = None
    policy: FencePolicy = FencePolicy.IGNORE


class Fencing:
    """Sets the guard's fence, or the reason for its absence; without a plan it stays."""

    def __init__(self, guard: Guard, plan: FencePlan | None = None) -> None:
        local = FencePlan(guard.limits, 0.0)
        self.plan = local if plan is None else plan
        self.is_followed = self.plan.policy is not FencePolicy.IGNORE
        """True if changes of the autopilot's fence matter."""
        self.refusal: str | None = None
        """Reason why there is no fence although all inputs are known; None if there is none."""
        self.note: str | None = None
        """Remark for the operator about a fence that is kept."""
        self.guard = guard
        self.anchor: LocalOrigin | None = None
        """Origin to which local metres of the configuration refer; None: not received yet."""
        self.is_doubted = False
        """True if the autopilot's fence has changed and is not downloaded yet."""
        self._origin: LocalOrigin | None = None
        self._read: AutopilotFenceRead | None = None
        self._flown: tuple[GeoFence, ...] = ()
        """The autopilot's fences of this flight, newest first; on the ground one at most."""
        self.fence_limits = FenceLimits()
        """The autopilot's fence by parameters; in the air the strictest of this flight."""
        self._reported_limits = FenceLimits()
        """The autopilot's fence by parameters, as reported last."""
        self.home_enu_m: Point | None = None
        """Centre of the autopilot's circular fence, east and north."""
        self.is_urgent = False
        """True if the autopilot's fence has to be downloaded again at once."""
        self.is_airborne = self.is_in_control = False
        self._settle()

    @property
    def is_ready(self) -> bool:
        """True if the guard has its fence."""
        return self.refusal is None and not self.missing

    @property
    def missing(self) -> list[str]:
        """Return the names of inputs that are still missing."""
        parts = {
            "the autopilot's fence": self._is_read and not self.is_doubted,
            "the origin": self._has_origin,
        }
        return [name for name, is_there in parts.items() if not is_there]

    @property
    def _is_read(self) -> bool:
        return not self.is_followed or self._read is not None

    @property
    def _has_origin(self) -> bool:
        """True if the origin is known, or nothing refers to it."""
        is_used = self.plan.site is not None or self.autopilot_fence is not None
        is_used = is_used or bool(self._flown) or self.anchor is not None
        return self._origin is not None or not is_used

    @property
    def description(self) -> str:
        """Description of the fence."""
        fence = self.guard.limits.fence
        if fence is None:
            return "none"
        text = f"{len(fence.polygon_enu_m)} corners, {len(fence.keep_out_enu_m)} keep-outs"
        if fence.also_inside_enu_m:
            text += f", further fences: {len(fence.also_inside_enu_m)}"
        return f"{text}, margin {fence.margin_m:.1f} m"

    @property
    def site(self) -> GeoFence | None:
        """The fence in degrees, of a file or of the autopilot; None: none, or not known yet."""
        return self.plan.site if self.plan.policy is not FencePolicy.USE else self.autopilot_fence

    @property
    def is_site_known(self) -> bool:
        """True if `site` is final: the autopilot's fence is downloaded, or not used."""
        return self.plan.policy is not FencePolicy.USE or self._read is not None

    @property
    def autopilot_fence(self) -> GeoFence | None:
        """The autopilot's fence as downloaded last; None if it has none, or it is unknown."""
        return None if self._read is None else self._read.fence

    @property
    def wants_reading(self) -> bool:
        """True if the autopilot's fence has to be downloaded: unknown, refused or in doubt.

        It is also downloaded when control begins: not every autopilot reports a changed fence.
        """
        if not self.is_followed:
            return False
        is_known = self._read is not None and self._read.problem is None and self.refusal is None
        return not is_known or self.is_doubted or self.is_urgent

    def set_origin(self, origin: LocalOrigin) -> None:
        """Set the origin of the local frame; the first one becomes the anchor."""
        self._origin = origin
        if self.anchor is None:
            self.anchor = origin
        self._settle()

    def recall(self, anchor: LocalOrigin) -> None:
        """Restore the anchor of an earlier process: its fence has not moved."""
        self.anchor = anchor
        self._settle()

    @property
    def flown(self) -> tuple[GeoFence, ...]:
        """The autopilot's fences of this flight, the newest first, and the circle around home."""
        return self._flown + self._circle

    def recall_flown(self, fences: tuple[GeoFence, ...], limits: FenceLimits | None) -> None:
        """Restore the autopilot's fences of the flight that an earlier process began."""
        self.is_airborne = True
        self._flown += tuple(fence for fence in fences if fence not in self._flown)
        if limits is not None:
            self.fence_limits = self.fence_limits.strictest(limits)
        self._settle()

    def take(self, event: AutopilotFenceRead) -> None:
        """Set the autopilot's fence; if the download fails in the air, the known one holds."""
        self.is_urgent = False
        is_unread = event.problem is not None and not event.is_unusable
        if is_unread and self.is_airborne and self._read is not None:
            return
        self._read, self.is_doubted = event, False
        fences: tuple[GeoFence, ...] = () if event.fence is None else (event.fence,)
        if self.is_airborne:
            fences += tuple(fence for fence in self._flown if fence not in fences)
        self._flown = fences
        self._settle()

    def take_limits(self, limits: FenceLimits) -> None:
        """Set the limits by the autopilot's parameters; in the air no limit gets wider."""
        if self.is_followed:
            self._reported_limits = limits
            self.fence_limits = self.fence_limits.strictest(limits) if self.is_airborne else limits
            self._settle()

    def set_home(self, home_enu_m: Point) -> None:
        """Set the autopilot's home, east and north; in the air a circle about the old one stays."""
        before = self.home_enu_m
        if before == home_enu_m:
            return
        circle = self._circle
        self.home_enu_m = home_enu_m
        if self.fence_limits.radius_m is None:
            return
        if self.is_airborne and before and math.dist(before, home_enu_m) > TOLERANCE_M:
            self._flown += circle
        self._settle()

    def doubt(self) -> None:
        """Note that the autopilot's fence changed; it must be downloaded before further use."""
        self.is_doubted = self.is_followed

    def read_again(self) -> None:
        """Request a new download of the autopilot's fence, whose reference may have moved."""
        self.is_urgent = self.is_followed

    def follow(self, *, is_airborne: bool, is_in_control: bool) -> None:
        """Update a flight state that changed: control downloads the fence, landing widens it."""
        if is_in_control and not self.is_in_control:
            self.read_again()
        self.is_airborne, self.is_in_control = is_airborne, is_in_control
        if not is_airborne:
            self._flown = () if self.autopilot_fence is None else (self.autopilot_fence,)
            self.fence_limits = self._reported_limits
        self._settle()

    def use_limits(self, limits: GuardLimits) -> None:
        """Set other limits of motion, with the same fence."""
        self.plan = replace(self.plan, limits=limits)
        self._settle()

    def forget(self, *, is_other: bool = False) -> None:
        """Drop the autopilot's origin and fence, because it restarted; the anchor stays.

        So do the fences of this flight, as it may restart in the air, unless it is another vehicle.
        """
        if is_other:
            self._flown, self.fence_limits, self.is_airborne = (), FenceLimits(), False
        elif self.is_airborne:
            self._flown = self.flown
        self._origin = self._read = self.home_enu_m = None
        self._reported_limits, self.is_doubted = FenceLimits(), False
        self._settle()

    @property
    def _circle(self) -> tuple[GeoFence, ...]:
        """The circle around home as a fence in the world, if there is one with a known centre."""
        radius_m, home, origin = self.fence_limits.radius_m, self.home_enu_m, self._origin
        if radius_m is None or home is None or origin is None:
            return ()
        middle_deg = origin.geodetic_from_enu((*home, 0.0))[:2]
        return (GeoFence(GeoArea((middle_deg,), radius_m)),)

    def _settle(self) -> None:
        self.refusal = self.note = None
        self._kept_to = ""
        fence: Fence | None = None
        envelope = self.plan.limits.envelope
        if self._is_read and self._has_origin:
            try:
                fence = self._fence()
                self._compare()
                fence = self._inside_circle(self._strictest(fence))
                envelope = self._between_heights(envelope)
            except ValueError as error:
                self.refusal = str(error)
        usable = fence if self.refusal is None else None
        self.guard.use(replace(self.plan.limits, fence=usable, envelope=envelope))

    def _inside_circle(self, fence: Fence | None) -> Fence | None:
        """Return the fence clipped to the autopilot's circle around home; None: neither is set."""
        radius_m, home = self.fence_limits.radius_m, self.home_enu_m
        if radius_m is None or home is None:
            return fence
        margin_m = max(self.plan.margin_m, self.fence_limits.margin_m)
        if fence is not None:
            margin_m = max(fence.margin_m, margin_m)
            if all(math.dist(home, corner) <= radius_m for corner in fence.polygon_enu_m):
                return fence
        self._keep_to(f"{radius_m:g} m about home")
        circle = circle_about(home, radius_m)
        if fence is None:
            return Fence(circle, margin_m)
        others = (*fence.also_inside_enu_m, circle)
        return Fence(fence.polygon_enu_m, margin_m, fence.keep_out_enu_m, others)

    def _keep_to(self, part: str) -> None:
        """Note a limit of the parameters that is stricter than the configuration."""
        self._kept_to = f"{self._kept_to}, {part}" if self._kept_to else part
        self.note = f"keeping to the autopilot's fence parameters: {self._kept_to}"

    def _between_heights(self, envelope: Envelope) -> Envelope:
        """Return the allowed heights, limited to the autopilot's by its margin."""
        limits = self.fence_limits
        most_m, least_m = envelope.altitude_max_m, envelope.altitude_min_m
        if limits.altitude_max_m is not None:
            most_m = min(most_m, limits.altitude_max_m - limits.margin_m)
        if limits.altitude_min_m is not None:
            least_m = max(least_m, limits.altitude_min_m + limits.margin_m)
        if (least_m, most_m) == (envelope.altitude_min_m, envelope.altitude_max_m):
            return envelope
        if least_m >= most_m:
            raise ValueError(
                f"the autopilot's fence parameters leave no altitude: above {least_m:g} m and "
                f"below {most_m:g} m; change them, or limits.altitude_min_m"
            )
        self._keep_to(f"heights from {least_m:g} to {most_m:g} m")
        return replace(envelope, altitude_min_m=least_m, altitude_max_m=most_m)

    def _fence(self) -> Fence | None:
        plan, site = self.plan, self.plan.site
        if plan.policy is FencePolicy.USE:
            site = self._autopilots() or (self._flown[0] if self._flown else None)
            if site is None:
                if self.fence_limits.radius_m is not None:
                    return None  # its circle is the fence
                raise ValueError("the autopilot has no fence to use")
        if site is None or self._origin is None:
            return self._local_fence(plan.limits.fence)
        local, step_m = site.local(self._origin), self._step_m()
        keep_outs = (*local.keep_out_enu_m, *_moved(plan.keep_out_enu_m, step_m))
        margin_m = plan.margin_m + local.distortion_m + DISTORTION * math.hypot(*step_m)
        return Fence(local.polygon_enu_m, margin_m, keep_outs)

    def _strictest(self, fence: Fence | None) -> Fence | None:
        """Return the intersection of a fence with earlier ones of this flight, or None."""
        others = [each for each in self._flown if self._is_another(each)]
        if fence is None or self._origin is None or not others:
            return fence
        own_margin_m = self.plan.margin_m or fence.margin_m
        locals_ = [each.local(self._origin) for each in others]
        inside = {fence.polygon_enu_m, *(each.polygon_enu_m for each in locals_)}
        smallest, *rest = sorted(inside, key=area_m2)
        theirs = [keep_out for each in locals_ for keep_out in each.keep_out_enu_m]
        keep_outs = dict.fromkeys((*fence.keep_out_enu_m, *theirs))
        margins_m = [fence.margin_m, *(own_margin_m + each.distortion_m for each in locals_)]
        self.note = (
            f"the autopilot's fence changed in flight: keeping to {len(inside)} until landing"
        )
        return Fence(smallest, max(margins_m), tuple(keep_outs), tuple(rest))

    def _is_another(self, theirs: GeoFence) -> bool:
        """Return True if a fence of the autopilot limits the flight besides the guard's own."""
        if self._is_circle(theirs):
            return False
        if self.plan.policy is FencePolicy.USE:
            return theirs is not self._flown[0]
        return self.is_in_control and self._difference(theirs) is not None

    def _is_circle(self, theirs: GeoFence) -> bool:
        """Return True if a fence of this flight is the circle around home that holds now."""
        if self._origin is None or theirs.inclusion.radius_m is None:
            return False
        other = theirs.local(self._origin)
        return any(
            difference(each.local(self._origin), other, TOLERANCE_M) is None
            for each in self._circle
        )

    def _local_fence(self, fence: Fence | None) -> Fence | None:
        """Return the configured fence in the current frame; None without one."""
        step_m = self._step_m()
        if fence is None or step_m == (0.0, 0.0):
            return fence
        polygon, *keep_outs = _moved((fence.polygon_enu_m, *fence.keep_out_enu_m), step_m)
        margin_m = fence.margin_m + DISTORTION * math.hypot(*step_m)
        return Fence(polygon, margin_m, tuple(keep_outs))

    def _step_m(self) -> Point:
        """Return the anchor in the current frame, east and north; `ValueError` if too far away."""
        origin, anchor, plan = self._origin, self.anchor, self.plan
        is_local = plan.limits.fence is not None or bool(plan.keep_out_enu_m)
        if origin is None or anchor is None or origin == anchor or not is_local:
            return (0.0, 0.0)
        east_m, north_m, _ = origin.zero_of(anchor)
        away_m = math.hypot(east_m, north_m)
        if away_m > MAX_STEP_M:
            raise ValueError(
                f"the autopilot's origin is {away_m / 1000.0:.1f} km from where it was; restart "
                "the companion to place the fence in local metres at the new one"
            )
        return (east_m, north_m)

    def _autopilots(self) -> GeoFence | None:
        """Return the autopilot's fence, or None; raise `ValueError` if the download failed."""
        if self._read is not None and self._read.problem is not None:
            raise ValueError(f"the autopilot's fence: {self._read.problem}")
        return self.autopilot_fence

    def _compare(self) -> None:
        """Compare the autopilot's fence with ours; raise `ValueError` on a difference.

        A missing fence is refused if one is required. In control a difference does not drop the
        fence: both are kept, see `_strictest`.
        """
        plan, read = self.plan, self._read
        if plan.policy not in (FencePolicy.COMPARE, FencePolicy.REQUIRE) or read is None:
            return
        is_unread = read.problem is not None and not read.is_unusable
        if plan.policy is FencePolicy.COMPARE and is_unread:
            self.note = f"the autopilot's fence is not compared: {read.problem}"
            return
        theirs = self._autopilots()
        if theirs is None:
            if plan.policy is FencePolicy.REQUIRE and not self.is_in_control:
                raise ValueError(
                    "the autopilot has no fence, and limits.autopilot_fence requires one"
                )
            self.note = "autopilot has no fence: only the companion has one"
            return
        differs = self._difference(theirs)
        if differs is not None and not self.is_in_control:
            raise ValueError(f"the autopilot's fence differs: {differs}")

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
    """Return the same positions in a frame whose zero is elsewhere."""
    east_m, north_m = step_m
    return [tuple((e + east_m, n + north_m) for e, n in polygon) for polygon in polygons]
