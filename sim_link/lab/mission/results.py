"""Record of a mission flight, and the result with its verdicts.

Theory of operation. The runner of a mission fills a `FlightRecord`, whose `situation` is the
current moment as conditions see it. At the end every expectation gets a verdict, the steps
together get one, and record and verdicts are a `MissionResult`.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

from companion.domain import PositionEnu
from companion.geometry.polygons import Point
from companion.io.files import plain
from companion.io.log_files import tlog_record
from companion.report.flight_summary import EstimatePoint
from sim_link.lab.mission.conditions import FlightSituation, parse_condition
from sim_link.lab.mission.script import (
    Appears,
    Bound,
    EmitterBound,
    Expectation,
    Mission,
    TextSeen,
    Violations,
    numbers_by_name,
)
from sim_link.lab.monitor.monitor import NOTHING, Scope
from sim_link.lab.monitor.scene import InvariantViolation


@dataclass(frozen=True, slots=True)
class StepOutcome:
    """Outcome of a step."""

    number: int
    """Number of the step, from 1."""
    name: str
    what: str
    """Text of the relevant parameters."""
    started_s: float
    ended_s: float
    failure: str = ""
    """Cause of its failure; empty if it is done."""

    @property
    def title(self) -> str:
        """Name of the step in reports."""
        return f"step {self.number} {self.name}"


@dataclass(frozen=True, slots=True)
class Report:
    """Report of a target by the companion."""

    time_s: float
    emitter: int | None
    position_enu_m: Point
    r95_m: float


@dataclass(frozen=True, slots=True)
class OperatorText:
    """Text for the operator."""

    time_s: float
    source: str
    text: str


@dataclass(slots=True)
class FlightRecord:
    """Record of one flight; times are seconds since the mission began."""

    situation: FlightSituation = field(default_factory=FlightSituation)
    """Situation at the moment, or at the end."""
    steps: list[StepOutcome] = field(default_factory=list)
    events: list[tuple[float, str, Mapping[str, object]]] = field(default_factory=list)
    """The companion's event log and the mission's own events, in the order of time."""
    estimates: list[EstimatePoint] = field(default_factory=list)
    reports: list[Report] = field(default_factory=list)
    texts: list[OperatorText] = field(default_factory=list)
    waypoints: list[tuple[float, Point, str]] = field(default_factory=list)
    track: list[tuple[float, PositionEnu]] = field(default_factory=list)
    messages: Counter[tuple[str, int]] = field(default_factory=Counter)
    """Number of messages of each sender and message id."""
    frames: list[tuple[float, bytes]] = field(default_factory=list)
    """Frames of companion and vehicle, if they were kept in memory."""
    violations: list[InvariantViolation] = field(default_factory=list)
    breaches: dict[str, float] = field(default_factory=dict)
    """Time at which an `always` was first false, by the expectation's name."""
    engaged_s: float | None = None
    ended_s: float = 0.0
    distance_m: float = 0.0
    closest_approach_m: float | None = None
    """Shortest distance to the fence in the whole flight."""
    failure: str = ""
    """Cause that ended the mission, other than a step; empty: none."""
    autopilot: str = ""
    """Autopilot that was flown: px4, ardupilot or other."""
    scope: Scope = NOTHING
    """Invariants that were judged, and the reasons why the others were not."""
    slack_s: float = 0.0
    """Extension of the time limits over those in lockstep, in seconds of flight."""
    late_s: float = 0.0
    """Largest scheduling delay of the hub, in seconds of flight."""
    slowed_to: str = ""
    """Speed that the machine kept up with; empty: the requested one."""
    is_interrupted: bool = False
    skipped: str = ""
    """Reason why it was not flown on this vehicle; empty if it was flown."""
    wall_s: float = 0.0
    """Real time that it took; not part of the event log."""
    cpu_s: float = 0.0
    """Processor time that it took, where it was flown in one process; neither."""

    def last_estimate(self, emitter: int) -> EstimatePoint | None:
        """Return the last estimate of an emitter before its report; None without one.

        A vehicle continues to measure on its way home, at low height and behind obstacles. Records
        without an id apply to every emitter.
        """
        report = self.report_of(emitter)
        until_s = math.inf if report is None else report.time_s
        for point in reversed(self.estimates):
            if point.emitter_id in (emitter, None) and point.time_s <= until_s:
                return point
        return None

    def report_of(self, emitter: int) -> Report | None:
        """Return the last report about an emitter; None without one."""
        return next((r for r in reversed(self.reports) if r.emitter in (emitter, None)), None)

    def without_history(self, emitter: int) -> FlightRecord:
        """Return the figures and the last estimate of an emitter, small enough to keep hundreds."""
        last, report = self.last_estimate(emitter), self.report_of(emitter)
        return replace(
            self,
            situation=FlightSituation(),
            steps=[],
            events=[],
            estimates=[] if last is None else [last],
            reports=[] if report is None else [report],
            texts=[],
            waypoints=[],
            track=[],
            messages=Counter(),
            frames=[],
            violations=[],
        )


STEPS = "all steps"
"""The name of the verdict on the steps."""


@dataclass(frozen=True, slots=True)
class ExpectationVerdict:
    """Verdict on one expectation."""

    name: str
    is_met: bool
    found: str
    """Result, shown beside the expectation."""


def verdicts_of(mission: Mission, record: FlightRecord) -> tuple[ExpectationVerdict, ...]:
    """Return the verdict on the steps, then those on the expectations in the script's order."""
    judged = (_judge(expectation, mission, record) for expectation in mission.expectations)
    return (_judge_steps(record), *judged)


def true_positions(mission: Mission) -> dict[int, Point]:
    """Return emitter positions by id, local ENU in m; the script's `emitter` first."""
    return {each.emitter_id: each.position_enu_m for each in (mission.emitter, *mission.emitters)}


def _judge_steps(record: FlightRecord) -> ExpectationVerdict:
    failed = next((step for step in record.steps if step.failure), None)
    if failed is not None:
        return ExpectationVerdict(STEPS, False, f"{failed.title}: {failed.failure}")
    if record.failure:
        return ExpectationVerdict(STEPS, False, record.failure)
    return ExpectationVerdict(STEPS, True, f"{len(record.steps)} done in {record.ended_s:.1f} s")


def _judge(expectation: Expectation, mission: Mission, record: FlightRecord) -> ExpectationVerdict:
    kind = expectation.kind
    value = getattr(expectation, kind)
    if kind == "always":
        judged = _always(value, record.breaches.get(expectation.name))
    else:
        judged = JUDGES[kind](value, mission, record)
    return ExpectationVerdict(expectation.name, *judged)


Judged = tuple[bool, str]
"""True if an expectation is met, and the text of the finding."""


def _final_error(bound: EmitterBound, mission: Mission, record: FlightRecord, of: str) -> Judged:
    """Judge the error by one of the point's radii, "r95_m" or "absolute_r95_m", or by none."""
    emitter = _emitter_of(bound, mission)
    point = record.last_estimate(emitter)
    if point is None:
        return False, "there is no estimate"
    error_m = math.dist(point.position_enu_m, true_positions(mission)[emitter])
    if not of:
        return _judge_bound(error_m, bound, "m")
    radius_m = getattr(point, of)
    if radius_m is None:
        return False, "the absolute R95 was not reported"
    kind = "absolute R95" if of == "absolute_r95_m" else "R95"
    return _judge_bound(error_m / radius_m, bound, f"times the {kind} of {radius_m:.2f} m")


def _emitter_of(bound: EmitterBound, mission: Mission) -> int:
    return mission.emitter.emitter_id if bound.emitter is None else bound.emitter


def _reported(bound: EmitterBound, mission: Mission, record: FlightRecord) -> Judged:
    report, engaged_s = record.report_of(_emitter_of(bound, mission)), record.engaged_s
    if report is None or engaged_s is None:
        return False, "the target was not reported"
    return _judge_bound(report.time_s - engaged_s, bound, "s")


def _violations(limit: Violations, _mission: Mission, record: FlightRecord) -> Judged:
    unjudged = record.scope.unjudged_of(limit.invariants)
    if len(unjudged) == len(limit.invariants):
        reasons = (f"{name} {record.scope.unjudged[name]}" for name in unjudged)
        return True, f"not judged: {'; '.join(reasons)}"
    counted = [v for v in record.violations if v.invariant in limit.invariants]
    found = f"{len(counted)}, expected at most {limit.at_most}"
    if counted:
        first = counted[0]
        found += f"; first {first.invariant} at {first.time_s:.2f} s: {first.what}"
    if unjudged:
        found += f"; not judged: {', '.join(unjudged)}"
    return len(counted) <= limit.at_most, found


def _appears(wanted: Appears, _mission: Mission, record: FlightRecord) -> Judged:
    count, when = _seen(wanted, record)
    return count >= wanted.at_least, f"seen {_times(count)}{when}, expected {wanted.at_least}"


def _never(unwanted: TextSeen, _mission: Mission, record: FlightRecord) -> Judged:
    count, when = _seen(unwanted, record)
    return count == 0, f"seen {_times(count)}{when}, expected never"


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _seen(wanted: TextSeen, record: FlightRecord) -> tuple[int, str]:
    sources = ("companion", "autopilot") if wanted.from_ is None else (wanted.from_,)
    if wanted.message is not None:
        number = numbers_by_name()[wanted.message]
        return sum(record.messages[source, number] for source in sources), ""
    text = wanted.text or ""
    said = [each for each in record.texts if each.source in sources and text in each.text]
    return len(said), f", first at {said[0].time_s:.1f} s: {said[0].text}" if said else ""


def _holds(condition: str, _mission: Mission, record: FlightRecord) -> Judged:
    is_met = parse_condition(condition).holds(record.situation)
    return is_met, f"at the end {condition} {'holds' if is_met else 'does not hold'}"


def _always(condition: str, broken_s: float | None) -> Judged:
    if broken_s is None:
        return True, f"{condition} was never false"
    return False, f"{condition} was false at {broken_s:.1f} s"


def _judge_bound(value: float, bound: Bound, unit: str) -> Judged:
    return bound.holds(value), f"{value:.2f} {unit}, expected {bound}"


JUDGES: dict[str, Callable[..., Judged]] = {
    "final_error_m": partial(_final_error, of=""),
    "error_over_r95": partial(_final_error, of="r95_m"),
    "error_over_absolute_r95": partial(_final_error, of="absolute_r95_m"),
    "reported_s": _reported,
    "time_s": lambda bound, _, record: _judge_bound(record.ended_s, bound, "s"),
    "distance_m": lambda bound, _, record: _judge_bound(record.distance_m, bound, "m"),
    "violations": _violations,
    "appears": _appears,
    "never": _never,
    "holds": _holds,
}
"""Each kind of expectation with its judge, but `always`, which is watched on the way."""


EPOCH_S = 946_684_800.0
"""2000-01-01 in Unix time: an invented clock has no date, and readers of tlogs want one."""


MAX_SLUG = 80
"""Maximum number of characters of a slug; a file name has two slugs and may have 255 in all."""


def slug(name: str) -> str:
    """Return a mission's name as part of a file name, cut to `MAX_SLUG`."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-")[:MAX_SLUG].strip("-") or "mission"


def flight_name(mission: str, flavour: str, how: str, seed: int) -> str:
    """Return the name of a flight's files and folder, without an ending."""
    return f"{slug(mission)}-{flavour}-{slug(how)}-seed{seed}"


def how_flown(speed: float | None, connect: str | None) -> str:
    """Return `lockstep` (no speed), `speed 4`, or the link to an external vehicle."""
    if connect is not None:
        return connect
    return "lockstep" if speed is None else f"speed {speed:g}"


BUSY_S = 0.2
"""Scheduling delay of a process above which setpoints and positions are lost."""


@dataclass(frozen=True, slots=True)
class MissionResult:
    """Result of a run; can be sent between processes."""

    mission: Mission
    file: str
    seed: int
    how: str
    record: FlightRecord = field(default_factory=FlightRecord)
    verdicts: tuple[ExpectationVerdict, ...] = ()
    """Verdicts on steps and expectations; empty: the flight did not come to an end."""
    report: str = ""
    """Path of the report; empty without one."""
    error: str = ""
    """Reason why it did not finish or has no report; empty: nothing went wrong."""

    def without_history(self) -> MissionResult:
        """Return the figures of the flight only, small enough to be kept of hundreds."""
        return replace(self, record=self.record.without_history(self.mission.emitter.emitter_id))

    @property
    def is_passed(self) -> bool:
        """True if every expectation is met, every step done, and nothing went wrong."""
        return not (self.failed or self.error or self.record.skipped)

    @property
    def failed(self) -> list[ExpectationVerdict]:
        """Verdicts that are not met."""
        return [verdict for verdict in self.verdicts if not verdict.is_met]

    @property
    def title(self) -> str:
        """Name of the flight in reports."""
        return f"{self.mission.name} ({self.flavour}), seed {self.seed}"

    @property
    def flight_name(self) -> str:
        """Name of its files, without an ending."""
        return flight_name(self.mission.name, self.flavour, self.how, self.seed)

    @property
    def flavour(self) -> str:
        """Flavour of the autopilot that was flown."""
        return self.record.autopilot or self.mission.autopilot.flavour

    @property
    def last_estimate(self) -> EstimatePoint | None:
        """Last estimate of the first emitter; None without one."""
        return self.record.last_estimate(self.mission.emitter.emitter_id)

    @property
    def final_error_m(self) -> float | None:
        """Error of the last estimate of the first emitter, m; None without one."""
        point = self.last_estimate
        return None if point is None else self.error_m(point)

    def error_m(self, point: EstimatePoint) -> float:
        """Return an estimate's horizontal error, m; by default of the first emitter."""
        truth = true_positions(self.mission)
        first = truth[self.mission.emitter.emitter_id]
        emitter = point.emitter_id
        position = first if emitter is None else truth.get(emitter, first)
        return math.dist(point.position_enu_m, position)

    @property
    def is_inside_r95(self) -> bool | None:
        """True if the true emitter is within R95 of the last estimate; None without one."""
        point = self.last_estimate
        return None if point is None else self.error_m(point) <= point.r95_m

    @property
    def pace(self) -> str:
        """Actual speed if it differs from the requested one; empty: as requested."""
        slowed_to = self.record.slowed_to
        return (
            f"this computer is too busy for {self.how}: slowed to {slowed_to}" if slowed_to else ""
        )

    @property
    def doubt(self) -> str:
        """Hint that the machine may have caused the failure, with a remedy; empty if not."""
        if self.is_passed or self.record.skipped or self.record.late_s <= BUSY_S:
            return ""
        return (
            f"this computer was too busy: a turn came {self.record.late_s:.1f} s of flight late; "
            "try a lower --speed, or lockstep"
        )

    @property
    def times_real_time(self) -> float:
        """Simulated seconds per second."""
        wall_s = self.record.wall_s
        return self.record.ended_s / wall_s if wall_s > 0.0 else math.inf

    @property
    def tlog(self) -> bytes:
        """The frames as a `.tlog`, at times since 2000; empty where a file was written instead."""
        records = (tlog_record(frame, EPOCH_S + time_s) for time_s, frame in self.record.frames)
        return b"".join(record for record in records if record is not None)

    @property
    def event_log(self) -> bytes:
        """The events as JSON lines; of two runs in lockstep with one seed these are the same."""
        lines = [
            {"t_s": round(time_s, 4), "kind": kind, **fields}
            for time_s, kind, fields in self.record.events
        ]
        lines += [
            {"kind": "verdict", "name": v.name, "is_met": v.is_met, "found": v.found}
            for v in self.verdicts
        ]
        dumps = (json.dumps(plain(line), allow_nan=False, separators=(",", ":")) for line in lines)
        return "".join(f"{line}\n" for line in dumps).encode("ascii")
