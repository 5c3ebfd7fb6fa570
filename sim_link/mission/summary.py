"""The few numbers of a run that are kept of many."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sim_link.mission.result import MissionResult
from sim_link.mission.verdicts import Verdict

BUSY_S = 0.2
"""Processes that wait so long for their turn cost setpoints and positions."""


@dataclass(frozen=True, slots=True)
class Summary:
    """One run, small enough to be kept of hundreds."""

    name: str
    flavour: str
    file: str
    seed: int
    how: str
    verdicts: tuple[Verdict, ...]
    time_s: float
    distance_m: float
    final_error_m: float | None
    r95_m: float | None
    closest_approach_m: float | None
    wall_s: float
    cpu_s: float = 0.0
    """Processor time; 0 where several processes flew."""
    late_s: float = 0.0
    """How late a turn came at most, in seconds of flight, where several processes flew."""
    is_interrupted: bool = False
    report: str = ""
    """Where the report is; empty: there is none."""
    error: str = ""
    """Why it did not come to an end, or has no report; empty: nothing went wrong."""

    @property
    def title(self) -> str:
        """What reports call it."""
        return f"{self.name} ({self.flavour}), seed {self.seed}"

    @property
    def failed(self) -> tuple[Verdict, ...]:
        """Verdicts that are not met."""
        return tuple(verdict for verdict in self.verdicts if not verdict.is_met)

    @property
    def is_passed(self) -> bool:
        """Whether all are met, and nothing went wrong."""
        return not self.failed and not self.error

    @property
    def is_flown(self) -> bool:
        """Whether it came to an end."""
        return bool(self.verdicts)

    @property
    def is_inside_r95(self) -> bool | None:
        """Whether the true emitter is within R95 of the last estimate."""
        if self.final_error_m is None or self.r95_m is None:
            return None
        return self.final_error_m <= self.r95_m

    @property
    def doubt(self) -> str:
        """Why a failure may be the machine's, and what to do; empty: nothing says so."""
        if self.is_passed or self.late_s <= BUSY_S:
            return ""
        return (
            f"this computer was too busy: a turn came {self.late_s:.1f} s of flight late; "
            "try a lower --speed, or lockstep"
        )

    @property
    def times_real_time(self) -> float:
        """Simulated seconds per second."""
        return self.time_s / self.wall_s if self.wall_s > 0.0 else math.inf


def summary_of(result: MissionResult) -> Summary:
    """The summary of a run."""
    record, mission = result.record, result.mission
    point = record.last_estimate(mission.emitter.emitter_id)
    return Summary(
        name=mission.name,
        flavour=result.flavour,
        file=result.file,
        seed=result.seed,
        how=result.how,
        verdicts=result.verdicts,
        time_s=record.ended_s,
        distance_m=record.distance_m,
        final_error_m=result.final_error_m,
        r95_m=None if point is None else point.r95_m,
        closest_approach_m=record.closest_approach_m,
        wall_s=record.wall_s,
        cpu_s=record.cpu_s,
        late_s=record.late_s,
        is_interrupted=record.is_interrupted,
    )


def campaign_lines(summaries: list[Summary]) -> list[str]:
    """What a campaign came to, in lines for people: each mission, then all of them."""
    names = list(dict.fromkeys((s.name, s.flavour) for s in summaries))
    lines = [_mission_line([s for s in summaries if (s.name, s.flavour) == n]) for n in names]
    passed = sum(summary.is_passed for summary in summaries)
    flown_s, wall_s = sum(s.time_s for s in summaries), sum(s.wall_s for s in summaries)
    cpu_s = sum(s.cpu_s for s in summaries)
    speed = f", {flown_s / wall_s:.0f} times real time" if wall_s > 0.0 else ""
    if cpu_s > 0.0:
        speed += f" ({flown_s / cpu_s:.0f} by processor time)"
    return [
        *lines,
        f"{passed} of {len(summaries)} flights passed; {flown_s:.0f} s flown in {wall_s:.1f} s "
        f"of flying{speed}",
    ]


def _mission_line(runs: list[Summary]) -> str:
    passed = sum(run.is_passed for run in runs)
    errors = [run.final_error_m for run in runs if run.final_error_m is not None]
    inside = [run.is_inside_r95 for run in runs if run.is_inside_r95 is not None]
    line = f"{runs[0].name} ({runs[0].flavour}): {passed}/{len(runs)} passed"
    if errors:
        line += f", error at most {max(errors):.2f} m, {sum(inside)}/{len(inside)} inside R95"
    flown_s, cpu_s = sum(run.time_s for run in runs), sum(run.cpu_s for run in runs)
    wall_s = sum(run.wall_s for run in runs)
    if wall_s > 0.0:
        line += f", {flown_s / wall_s:.0f}x"
    return f"{line} ({flown_s / cpu_s:.0f}x by processor time)" if cpu_s > 0.0 else line
