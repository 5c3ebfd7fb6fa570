"""What was seen of a flight: everything that verdicts and reports are made of."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from companion.domain import Point, PositionEnu
from sim_link.monitor.scope import NOTHING, Scope


@dataclass(frozen=True, slots=True)
class StepOutcome:
    """How a step ended."""

    number: int
    """From 1, as people count."""
    name: str
    what: str
    """Its parameters that matter, in words."""
    started_s: float
    ended_s: float
    failure: str = ""
    """Empty: it is done."""

    @property
    def title(self) -> str:
        """What reports call it."""
        return f"step {self.number} {self.name}"


@dataclass(frozen=True, slots=True)
class EstimatePoint:
    """The estimate after a measurement, and the innovations that led to it."""

    time_s: float
    emitter: int | None
    state: str
    position_enu_m: Point
    r95_m: float
    range_innovation_m: float | None = None
    bearing_innovation_rad: float | None = None


@dataclass(frozen=True, slots=True)
class Report:
    """A target that the companion reported."""

    time_s: float
    emitter: int | None
    position_enu_m: Point
    r95_m: float


@dataclass(frozen=True, slots=True)
class Said:
    """A text for the operator."""

    time_s: float
    source: str
    """companion or autopilot."""
    text: str


@dataclass(frozen=True, slots=True)
class Violated:
    """An invariant that did not hold."""

    time_s: float
    invariant: str
    text: str


@dataclass(slots=True)
class FlightRecord:
    """One flight as it was seen; times are seconds since the mission began."""

    steps: list[StepOutcome] = field(default_factory=list)
    events: list[tuple[float, str, Mapping[str, object]]] = field(default_factory=list)
    """The companion's event log and the mission's own events, in the order of time."""
    estimates: list[EstimatePoint] = field(default_factory=list)
    reports: list[Report] = field(default_factory=list)
    texts: list[Said] = field(default_factory=list)
    phases: list[tuple[float, str]] = field(default_factory=list)
    waypoints: list[tuple[float, Point, str]] = field(default_factory=list)
    track: list[tuple[float, PositionEnu]] = field(default_factory=list)
    messages: Counter[tuple[str, int]] = field(default_factory=Counter)
    """How often each sender's messages were seen, by message id."""
    frames: list[tuple[float, bytes]] = field(default_factory=list)
    """What companion and vehicle sent, where it was kept in memory."""
    violations: list[Violated] = field(default_factory=list)
    breaches: dict[str, float] = field(default_factory=dict)
    """When an `always` was first false, by the expectation's name."""
    engaged_s: float | None = None
    """When control was first given."""
    ended_s: float = 0.0
    distance_m: float = 0.0
    closest_approach_m: float | None = None
    """To the fence, in the whole flight."""
    failure: str = ""
    """What ended the mission, beside a step; empty: nothing."""
    autopilot: str = ""
    """Who was flown: px4, ardupilot or other."""
    scope: Scope = NOTHING
    """Which invariants were judged, and why the others were not."""
    slack_s: float = 0.0
    """By how much limits of time were wider than in lockstep, in seconds of flight."""
    late_s: float = 0.0
    """How late the hub's turn came at most, in seconds of flight: how busy the machine was."""
    is_interrupted: bool = False
    """Somebody asked for the end."""
    wall_s: float = 0.0
    """Real time that it took; not part of the event log."""
    cpu_s: float = 0.0
    """Processor time that it took, where it was flown in one process; neither."""

    def last_estimate(self, emitter: int) -> EstimatePoint | None:
        """The last one of an emitter while it was looked for, which ends when it is reported.

        On its way home a vehicle goes on measuring, low and behind whatever stands there. Whatever
        has no id is of every emitter.
        """
        report = self.report_of(emitter)
        until_s = math.inf if report is None else report.time_s
        for point in reversed(self.estimates):
            if point.emitter in (emitter, None) and point.time_s <= until_s:
                return point
        return None

    def report_of(self, emitter: int) -> Report | None:
        """The last report about an emitter."""
        return next((r for r in reversed(self.reports) if r.emitter in (emitter, None)), None)
