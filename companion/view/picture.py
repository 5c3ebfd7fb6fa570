"""One moment of a flight as plain JSON values: what every view draws.

Lengths are metres in the local frame, east first; times are seconds of the companion's clock. A
value that is not known is None. Texts are as they came: whoever shows them escapes them.
"""

from __future__ import annotations

from collections.abc import Mapping

from companion.config.schema import CompanionConfig
from companion.domain import EstimateState, TargetEstimate
from companion.geometry.ellipse import ellipse_95
from companion.geometry.frames import LocalOrigin
from companion.guidance.fencing import Fencing
from companion.guidance.states import PHASE_WORDS, Phase
from companion.guidance.status import EmitterStatus, GuidanceStatus
from companion.link.endpoint import CompanionEndpoint

Json = dict[str, object]

ESTIMATE_WORDS = {
    EstimateState.SEARCHING: "searching",
    EstimateState.AMBIGUOUS: "two places are possible",
    EstimateState.LOCALISED: "localised",
    EstimateState.DIVERGED: "recovering",
}


def scene_of(config: CompanionConfig) -> Json:
    """What does not change during a flight.

    Args:
        config: Of the flight.
    """
    mission = config.mission
    return {
        "stop_radius_m": mission.stop_radius_m,
        "old_after_s": {
            "autopilot": 1.0,
            "position": 0.5,
            "ranging": mission.ranging_timeout_s,
        },
    }


def picture_of(endpoint: CompanionEndpoint, now_s: float) -> Json:
    """What is known now.

    Args:
        endpoint: The companion.
        now_s: The present.
    """
    session = endpoint.session
    status = session.status(now_s)
    vehicle = session.vehicle
    return {
        "t_s": now_s,
        "phase": status.phase.value,
        "phase_text": _phase_text(status),
        "phase_detail": status.detail,
        "mode": vehicle.name_of(status.mode),
        "is_armed": status.is_armed,
        "is_link_lost": status.is_link_lost and endpoint.binding.heard_s is not None,
        "battery_pct": status.battery_pct,
        "fence": _fence(session.fencing),
        "origin": _origin(vehicle.origin),
        "vehicle": status.vehicle_enu_m,
        "height_m": status.height_m,
        "distance_m": status.distance_m,
        "estimate": None if status.estimate is None else _estimate(status.estimate),
        "emitters": [_emitter(emitter) for emitter in status.emitters],
        "waypoint": _waypoint(status),
        "setpoint": status.setpoint_enu_m,
        "guard": status.guard,
        "nlos_share": status.health.nlos_share,
        "accepted": status.accepted,
        "refused": dict(status.refused),
        "bad_frames": endpoint.bad_frames,
        "setpoint_rate_hz": endpoint.setpoint_rate_hz(now_s),
        "ages_s": ages_s(endpoint, now_s),
    }


def _phase_text(status: GuidanceStatus) -> str:
    words = PHASE_WORDS.get(status.phase, status.phase.value)
    is_localised = status.estimate is not None and status.estimate.state is EstimateState.LOCALISED
    return "localised: confirming" if status.phase is Phase.NORMAL and is_localised else words


def _fence(fencing: Fencing) -> Json:
    """What the guard keeps now, which need not be what the configuration says."""
    fence = fencing.guard.limits.fence
    return {
        "polygon": None if fence is None else fence.polygon_enu_m,
        "keep_out": () if fence is None else fence.keep_out_enu_m,
        "words": fencing.words,
        "refusal": fencing.refusal,
        "missing": fencing.missing,
    }


def _origin(origin: LocalOrigin | None) -> tuple[float, float] | None:
    return None if origin is None else (origin.latitude_deg, origin.longitude_deg)


def _estimate(estimate: TargetEstimate) -> Json:
    ellipse = ellipse_95(estimate.position_enu_m, estimate.covariance_m2)
    return {
        "state": estimate.state.value,
        "words": ESTIMATE_WORDS[estimate.state],
        "place": estimate.position_enu_m,
        "ellipse": ellipse.corners_enu_m(),
        "r95_m": estimate.r95_m,
        "alternative": estimate.alternative_enu_m,
        "range_offset_m": estimate.range_offset_m,
        "bearing_offset_rad": estimate.bearing_offset_rad,
        "measurements": estimate.measurements,
    }


def _emitter(emitter: EmitterStatus) -> Json:
    estimate = emitter.estimate
    words = "not heard" if estimate is None else ESTIMATE_WORDS[estimate.state]
    if emitter.is_reported:
        words = f"reported, {words}"
    elif not emitter.is_current:
        words = f"waiting, {words}"
    return {
        "name": str(emitter.emitter_id),
        "state": words,
        "place": None if estimate is None else estimate.position_enu_m,
        "r95_m": None if estimate is None else estimate.r95_m,
        "is_current": emitter.is_current,
        "is_reported": emitter.is_reported,
    }


def _waypoint(status: GuidanceStatus) -> Json | None:
    waypoint = status.waypoint
    if waypoint is None:
        return None
    return {
        "place": waypoint.position_enu_m,
        "reason": waypoint.reason.value,
        "detail": waypoint.detail,
    }


def ages_s(endpoint: CompanionEndpoint, now_s: float) -> Mapping[str, float | None]:
    """How long ago each input was last heard; None: never."""
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
