"""How the mission is flown, and what of it may be changed while the companion runs.

What is tuned is how the mission is flown, never where it may be flown: fence, keep-outs and the
height band are read-only. A change comes as whole records that were checked together, and takes
effect with the next control tick; the guard moves from one speed to the other within its
acceleration, as from one waypoint to the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Any, Literal

import msgspec

from companion.domain import Distance, NonNegative, Params, Positive, Waiting
from companion.guard.gate import GuardLimits
from companion.planning.planner import Planner

StickReaction = Literal["yield", "hold", "ignore"]
Percent = Annotated[float, msgspec.Meta(ge=0.0, le=100.0)]


class SessionParams(Params, frozen=True):
    """How the mission is flown."""

    engage: Literal["operator", "auto"] = "operator"
    """`operator`: the mode switch gives control; `auto`: arm, take off, ask once (simulation)."""
    altitude_m: Distance = 20.0
    """Search altitude above home."""
    stop_radius_m: Distance = 1.0
    """The target is reported once R95 stays under this ..."""
    stop_confirm_s: Waiting = 10.0
    """... for this long."""
    settle_s: Waiting | None = 45.0
    """Or, where that is out of reach, once R95 has improved by less than 8 % for this long; null:
    never."""
    on_localised: Literal["hold", "return", "land"] = "hold"
    """Mode the autopilot is asked for after the report, a value of `FlightMode`."""
    ranging_timeout_s: Annotated[float, msgspec.Meta(ge=0.5, le=3600.0)] = 5.0
    """Without a usable measurement for this long: hold."""
    degraded_after_s: Waiting = 2.0
    """Without one for this long: fly on, slower."""
    coast_drift_mps: NonNegative = 1.0
    """How fast the target may move away from its estimate while nothing is heard of it."""
    coast_sigma_max_m: Positive = 30.0
    """An estimate that is less certain than this, one sigma, is not flown on without ranging."""
    on_sticks: StickReaction = "yield"
    """What a pilot who moves the sticks gets: the vehicle stays and then is left to the pilot,
    stays only, or flies on."""
    battery_low_pct: Percent = 20.0
    """At this charge the leg is finished, what is known is reported, and the vehicle returns."""
    battery_critical_pct: Percent = 10.0
    """At this charge the vehicle is handed back at once by asking for the return."""

    def __post_init__(self) -> None:
        if self.battery_low_pct < self.battery_critical_pct:
            raise ValueError("battery_low_pct must not be below battery_critical_pct")


class When(Enum):
    """When a parameter may be changed."""

    ANY_TIME = "at any time but during launch and hand-back"
    DISARMED = "only while the vehicle is disarmed"
    NEVER = "never"


@dataclass(frozen=True, slots=True)
class Tuning:
    """What the parts of a session work with."""

    params: SessionParams
    limits: GuardLimits
    """With the fence that the session began with."""
    planner: Planner[Any]
    """Of the same kind as before: it goes on with what the one before remembered."""
