"""Snapshot of a flight as plain values, for the page, the terminal and log lines.

Lengths are metres in the local frame, east first; times are seconds of the companion's clock. An
unknown value is None. Texts are unescaped: a view has to escape them. The operator's
next step is one or two short sentences at every moment.

The log lines are for a console without a live screen.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

from companion.area_handoff import pod_colours
from companion.config.schema import CompanionConfig
from companion.domain import EstimateState, PositionEnu, TargetEstimate, Waypoint
from companion.estimation.antenna import ABOUT_VERTICAL, antenna_axes_enu
from companion.estimation.target_estimate import aside_of_m
from companion.geometry.coordinates import combined
from companion.geometry.polygons import Point, ellipse_95
from companion.guidance.events import OperatorCommand
from companion.guidance.fencing import Fencing
from companion.guidance.handover import GRANT_HOW
from companion.guidance.messages import radii_of
from companion.guidance.phases import HAS_VEHICLE, PHASE_NAMES, Phase
from companion.guidance.readiness import missing_inputs
from companion.guidance.session import EmitterStatus, GuidanceSession, GuidanceStatus
from companion.link.endpoint import CompanionEndpoint
from companion.run import FlightView
from companion.search.searched_flight import GOOD_POD

TAKE_BACK = "Any other mode takes control back at once."
ALWAYS = {
    Phase.LAUNCHING: "Stand clear: it takes off by itself. Any mode switch or moved stick ends it.",
    Phase.FINISHED: (
        "Read the result. Hand over a position by HAND OVER on the map, or by handoff.txt."
    ),
    Phase.HANDBACK: "Take over: it asks the autopilot to hold or to return, and stops flying.",
    Phase.STOPPED: "You have control. The companion has ended; start it again for another search.",
}
"""Phases whose next step does not depend on anything else."""


def next_step(endpoint: CompanionEndpoint, status: GuidanceStatus) -> str:
    """Return the next step; texts of phases have precedence."""
    vehicle = endpoint.session.vehicle
    if endpoint.binding.heard_s is None:
        return "Switch the autopilot on. It is not heard yet: check cable, port and --connect."
    if status.is_link_lost:
        return "Watch the vehicle: it follows its own failsafe. Check the link to the autopilot."
    words = ALWAYS.get(status.phase)
    if words is not None:
        return words
    guided = vehicle.guided_name
    match status.phase:
        case Phase.WAITING:
            return _while_waiting(endpoint, status)
        case Phase.STANDBY:
            if endpoint.session.context.is_launch_wanted:
                return "Stand clear: it is about to take off by itself."
            if not status.is_armed:
                return f"Arm, take off, and switch to {guided} to hand over control."
            return f"Switch to {guided} to hand over control. {TAKE_BACK}"
        case Phase.HOLD:
            return _while_holding(status)
        case Phase.YIELD:
            return _after_yielding(endpoint, guided)
    return _in_search(status)


def _while_waiting(endpoint: CompanionEndpoint, status: GuidanceStatus) -> str:
    if status.detail:  # the detail names the next step already
        return (
            "Switch to another mode, for example Hold or Loiter. Then control can be handed over."
        )
    session = endpoint.session
    missing = missing_inputs(session.vehicle, session.fencing, status.time_s)
    if not missing:
        return "Wait a moment: the autopilot is nearly ready."
    names = " and ".join(dict.fromkeys(missing))
    return f"Wait for {names}. Satellites need open sky; this takes up to a minute."


def _in_search(status: GuidanceStatus) -> str:
    estimate = status.estimate
    if status.phase is Phase.DEGRADED:
        return f"Watch it: it flies slowly while an input is degraded. {TAKE_BACK}"
    if estimate is None:
        return f"Watch it search for the emitter. {TAKE_BACK}"
    if estimate.state is EstimateState.AMBIGUOUS:
        return f"Watch it: two positions fit, and it flies to decide between them. {TAKE_BACK}"
    if estimate.state is EstimateState.LOCALISED:
        return "Wait for the report: it is confirming the position. Get the ground team ready."
    return f"Watch the red circle shrink with every crossing. {TAKE_BACK}"


def _while_holding(status: GuidanceStatus) -> str:
    if "operator" in status.detail:
        return "Press RESUME on the map to continue, or RETURN to end the search."
    if "ranging" in status.detail:
        return "Check the radio. The search continues once the emitter is heard; or move closer."
    return "Watch it: it continues by itself when this is over. Or take over with the mode switch."


def _after_yielding(endpoint: CompanionEndpoint, guided: str) -> str:
    authority = endpoint.session.authority
    if authority.grant_reason is not None:
        return f"You have control. To resume: {GRANT_HOW}, then switch the mode."
    return f"You have control. To resume: stay in another mode until ready, then {guided}."


Json = dict[str, object]

STATE_NAMES = {
    EstimateState.SEARCHING: "searching",
    EstimateState.AMBIGUOUS: "two positions are possible",
    EstimateState.LOCALISED: "localised",
    EstimateState.DIVERGED: "recovering",
}


def scene_of(config: CompanionConfig) -> Json:
    """Return the values that do not change during a flight."""
    mission, has_search = config.mission, config.search.detection is not None
    return {
        "stop_radius_m": mission.stop_radius_m,
        "has_antenna": config.estimation.filter.antenna.kind not in ABOUT_VERTICAL,
        "pod_colours": pod_colours() if has_search else None,
        "old_after_s": {"autopilot": 1.0, "position": 0.5, "ranging": mission.ranging_timeout_s},
    }


def picture_of(endpoint: CompanionEndpoint, now_s: float) -> Json:
    """Return the values of this moment."""
    session = endpoint.session
    status = session.status(now_s)
    vehicle = session.vehicle
    origin, waypoint = vehicle.origin, status.waypoint
    words = PHASE_NAMES.get(status.phase, status.phase.value)
    is_localised = status.estimate is not None and status.estimate.state is EstimateState.LOCALISED
    return {
        "t_s": now_s,
        "phase": status.phase.value,
        "phase_text": (
            "localised: confirming" if status.phase is Phase.NORMAL and is_localised else words
        ),
        "phase_detail": status.detail,
        "next_step": next_step(endpoint, status),
        "objections": {each.value: session.objection_to(each) for each in OperatorCommand},
        "mode": vehicle.name_of(status.mode),
        "is_armed": status.is_armed,
        "is_link_lost": status.is_link_lost and endpoint.binding.heard_s is not None,
        "battery_pct": status.battery_pct,
        "fence": _fence(session.fencing),
        "origin": None if origin is None else (origin.latitude_deg, origin.longitude_deg),
        "vehicle": status.vehicle_enu_m,
        "height_m": status.height_m,
        "antenna": _antenna_view(endpoint, now_s),
        "distance_m": status.distance_m,
        "estimate": None if status.estimate is None else _estimate(status.estimate),
        "emitters": [_emitter(emitter) for emitter in status.emitters],
        "searched": searched_text(session),
        "radios": radio_texts(endpoint, now_s),
        "waypoint": None if waypoint is None else _waypoint(waypoint),
        "setpoint": status.setpoint_enu_m,
        "guard": status.guard,
        "nlos_share": status.health.nlos_share,
        "accepted": status.accepted,
        "refused": dict(status.refused),
        "bad_frames": endpoint.bad_frames,
        "setpoint_rate_hz": endpoint.outlet.setpoint_rate_hz(now_s),
        "ages_s": ages_s(endpoint, now_s),
    }


def _fence(fencing: Fencing) -> Json:
    """Return the guard's fence, which may differ from the configured one."""
    fence = fencing.guard.limits.fence
    return {
        "polygon": None if fence is None else fence.polygon_enu_m,
        "also_inside": () if fence is None else fence.also_inside_enu_m,
        "keep_out": () if fence is None else fence.keep_out_enu_m,
        "text": fencing.description,
        "refusal": fencing.refusal,
        "missing": fencing.missing,
    }


VIEW_REACH_M = 60.0
"""Length of a field of view that does not meet the ground."""
VIEW_CORNERS = 36


def _antenna_view(endpoint: CompanionEndpoint, now_s: float) -> Json | None:
    """Return the antenna's boresight and field of view on the ground; None: unknown.

    The ground lies at the height of the target. A view of half of all directions or more has no
    outline: almost all directions are inside.
    """
    session = endpoint.session
    params = session.tracker.params.filter
    antenna, track = params.antenna, session.vehicle.track
    state, attitude = track.latest, track.attitude_at(now_s)
    if antenna.kind in ABOUT_VERTICAL or state is None or attitude is None:
        return None
    roll_pitch = attitude.tilt_rad or (0.0, 0.0)
    axes = antenna_axes_enu((*roll_pitch, attitude.yaw_ned_rad), antenna.mount_deg)
    height_m = state.position_enu_m[2] - session.tracker.target_height_m
    half_rad = math.radians(0.5 * antenna.field_of_view_deg)
    turns = (2.0 * math.pi * i / VIEW_CORNERS for i in range(VIEW_CORNERS))
    edge = [
        (math.cos(half_rad), math.sin(half_rad) * math.cos(t), math.sin(half_rad) * math.sin(t))
        for t in turns
    ]
    rays = [axes[0], *(combined(axes, each) for each in edge if half_rad < 0.5 * math.pi)]
    points = [_met_on_ground(state.position_enu_m, ray, height_m) for ray in rays]
    return {"ahead": points[0], "outline": points[1:]}


def _met_on_ground(sensor_enu_m: PositionEnu, ray: PositionEnu, height_m: float) -> Point:
    """Return the point where a ray meets the ground, or the one at `VIEW_REACH_M`."""
    (east, north, _), (e, n, u) = sensor_enu_m, ray
    level = math.hypot(e, n)
    reach_m = level * height_m / -u if u < 0.0 < height_m else VIEW_REACH_M
    share = min(reach_m, VIEW_REACH_M) / level if level > 0.0 else 0.0
    return (east + share * e, north + share * n)


def _words(estimate: TargetEstimate) -> str:
    """Return the text of the state, and how to resolve an ambiguity."""
    words, aside_m = STATE_NAMES[estimate.state], aside_of_m(estimate)
    return words if aside_m is None else f"{words}: go {aside_m:.0f} m to the side"


def _estimate(estimate: TargetEstimate) -> Json:
    ellipse = ellipse_95(estimate.position_enu_m, estimate.covariance_m2)
    return {
        "state": estimate.state.value,
        "text": _words(estimate),
        "position": estimate.position_enu_m,
        "ellipse": ellipse.corners_enu_m(),
        "r95_m": estimate.r95_m,
        "absolute_r95_m": estimate.absolute_r95_m,
        "own_text": estimate.own.text,
        "alternative": estimate.alternative_enu_m,
        "range_offset_m": estimate.range_offset_m,
        "bearing_offset_rad": estimate.bearing_offset_rad,
        "measurements": estimate.measurements,
    }


def _emitter(emitter: EmitterStatus) -> Json:
    estimate = emitter.estimate
    words = "not heard" if estimate is None else _words(estimate)
    if emitter.is_reported:
        words = f"reported, {words}"
    elif not emitter.is_current:
        words = f"waiting, {words}"
    return {
        "name": str(emitter.emitter_id),
        "state": words,
        "position": None if estimate is None else estimate.position_enu_m,
        "r95_m": None if estimate is None else estimate.r95_m,
        "absolute_r95_m": None if estimate is None else estimate.absolute_r95_m,
        "is_current": emitter.is_current,
        "is_reported": emitter.is_reported,
    }


def radio_texts(endpoint: CompanionEndpoint, now_s: float) -> tuple[tuple[str, str], ...]:
    """Return each radio's name and state."""
    found = [radio.status(now_s) for radio in endpoint.radios]
    return tuple((status.name, status.text) for status in found)


def _waypoint(waypoint: Waypoint) -> Json:
    return {
        "position": waypoint.position_enu_m,
        "reason": waypoint.reason.value,
        "detail": waypoint.detail,
    }


def ages_s(endpoint: CompanionEndpoint, now_s: float) -> Mapping[str, float | None]:
    """Return the age of each input, in seconds; None: never received."""
    session = endpoint.session
    state = session.vehicle.track.latest
    heard = {
        "autopilot": endpoint.binding.heard_s,
        "position": None if state is None else state.time_s,
        "ranging": session.tracker.last_accepted_s,
    }
    return {
        name: None if time_s is None else max(0.0, now_s - time_s) for name, time_s in heard.items()
    }


@dataclass(frozen=True, slots=True)
class FlightSnapshot:
    """Contents of the terminal screen."""

    status: GuidanceStatus
    setpoint_rate_hz: float
    bad_frames: int
    stop_radius_m: float
    ages_s: Mapping[str, float | None]
    time_to_go_s: float | None = None
    radios: tuple[tuple[str, str], ...] = ()
    """Names and states."""
    next_step: str = ""
    """The operator's next step."""
    searched: str | None = None
    """Searched area until now; None once counting has ended, or without a detection model."""


def searched_text(session: GuidanceSession) -> str | None:
    """Return the text of the searched share of the area; None unless it is counted."""
    searching = session.searching
    if not searching.is_counting or not searching.is_worth_reporting:
        return None
    state = searching.state
    if state is None:
        return None
    good = 100.0 * state.share_at(GOOD_POD)
    return f"POS {100.0 * state.pos:.0f} %, {good:.0f} % of the area at 80 % or more"


def flight_snapshot(
    endpoint: CompanionEndpoint, now_s: float, time_to_go_s: float | None = None
) -> FlightSnapshot:
    """Return the snapshot of a flight at this moment."""
    status = endpoint.session.status(now_s)
    return FlightSnapshot(
        status=status,
        setpoint_rate_hz=endpoint.outlet.setpoint_rate_hz(now_s),
        bad_frames=endpoint.bad_frames,
        stop_radius_m=endpoint.session.params.stop_radius_m,
        ages_s=ages_s(endpoint, now_s),
        time_to_go_s=time_to_go_s,
        radios=radio_texts(endpoint, now_s),
        next_step=next_step(endpoint, status),
        searched=searched_text(endpoint.session),
    )


WINDOW_S = 15.0
"""The radius shrinks in steps, crossing by crossing: a shorter window jumps, a longer one lags."""
MIN_WINDOW_S = 5.0
MAX_S = 600.0
"""Longest remaining time that is shown."""


class TimeToGo:
    """Extrapolates R95, which shrinks about exponentially, to the radius of the report."""

    def __init__(self) -> None:
        self._radii: deque[tuple[float, float]] = deque()
        self._under_since_s: float | None = None

    def of_flight(self, endpoint: CompanionEndpoint, now_s: float) -> float | None:
        """Return the seconds to go of a flight, whose stop rule a station may change, or None."""
        params, estimate = endpoint.session.params, endpoint.session.estimate
        r95_m = None if estimate is None else estimate.settled_r95_m
        return self.observe(now_s, r95_m, params.stop_radius_m, params.stop_confirm_s)

    def observe(
        self, now_s: float, r95_m: float | None, stop_radius_m: float, confirm_s: float
    ) -> float | None:
        """Return the seconds to go; None: unknown, as without an R95."""
        if r95_m is None or not r95_m > 0.0:
            self._radii.clear()
            self._under_since_s = None
            return None
        if r95_m <= stop_radius_m:
            since_s = now_s if self._under_since_s is None else self._under_since_s
            self._under_since_s = since_s
            return max(0.0, confirm_s - (now_s - since_s))
        self._under_since_s = None
        self._radii.append((now_s, math.log(r95_m)))
        while now_s - self._radii[0][0] > WINDOW_S:
            self._radii.popleft()
        log_r95 = math.log(r95_m)
        first_s, first = self._radii[0]
        if now_s - first_s < MIN_WINDOW_S:
            return None
        rate = (first - log_r95) / (now_s - first_s)
        if rate <= 0.0:
            return None
        to_go_s = (log_r95 - math.log(stop_radius_m)) / rate + confirm_s
        return to_go_s if to_go_s <= MAX_S else None


log = logging.getLogger("companion.view")

PERIOD_S = 15.0
"""Seconds of the flight between two lines."""
REPORTED_PHASES = HAS_VEHICLE | {Phase.LAUNCHING}
"""Phases that are reported: events on the ground have texts, and a log must not grow."""


class PlainView(FlightView):
    """Logs the lines of one flight, whose texts are log lines already."""

    def __init__(self) -> None:
        self._next_s = -math.inf

    def update(self, endpoint: CompanionEndpoint, now_s: float) -> None:
        """Log a line if one is due."""
        if now_s < self._next_s or endpoint.session.phase not in REPORTED_PHASES:
            return
        self._next_s = now_s + PERIOD_S
        status = endpoint.session.status(now_s)
        line = f"{status.time_s:7.1f} s  {status.phase.value}, flown {status.distance_m:.0f} m"
        if status.estimate is not None:
            line += f", {status.estimate.state.value} {radii_of(status.estimate)}"
        log.info("%s", line)
