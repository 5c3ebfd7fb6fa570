"""What a campaign is made of: trials that can be run alone, and what they found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from sim_link.monitor.violation import Violation


@dataclass(frozen=True, slots=True)
class Trial:
    """One piece of work, which depends on these values only."""

    part: str
    seed: int
    size: float = 1.0
    """How long or how much, in the unit of the part; a replay uses the same."""

    @property
    def name(self) -> str:
        """How a replay is asked for."""
        return f"{self.part}:{self.seed}" + ("" if self.size == 1.0 else f":{self.size:g}")


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that must not happen, and how to see it again."""

    trial: str
    what: str


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a trial found and measured."""

    trial: Trial
    findings: tuple[str, ...] = ()
    """What must not happen; empty: the trial passed."""
    sums: Mapping[str, float] = field(default_factory=dict)
    """Figures that are added over all trials."""
    most: Mapping[str, float] = field(default_factory=dict)
    """Figures of which the greatest counts."""
    least: Mapping[str, float] = field(default_factory=dict)
    """Figures of which the least counts."""
    story: tuple[str, ...] = ()
    """What happened, for whoever replays the trial."""


class Part(Protocol):
    """One part of a campaign."""

    name: str
    title: str

    def trials(self, amount: float, seed: int) -> Sequence[Trial]:
        """The trials of so much of it."""

    def run(self, trial: Trial) -> Outcome:
        """Run one of them."""

    def cost(self, trial: Trial) -> float:
        """About how many seconds of one core it takes; for progress and fair shares."""


def findings_of(violations: Sequence[Violation]) -> tuple[str, ...]:
    """The violations of a flight as findings."""
    return tuple(str(violation) for violation in violations)


def trial_seed(seed: int, index: int) -> int:
    """The seed of the `index`-th trial of a campaign."""
    return seed * 1_000_000 + index
