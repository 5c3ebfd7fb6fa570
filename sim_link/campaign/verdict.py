"""What no single trial can judge, and the report of a campaign."""

from __future__ import annotations

from collections.abc import Mapping

from sim_link.campaign.gaps import MOST_FALSE_LOSSES_PER_10_H
from sim_link.campaign.runner import Tally
from sim_link.campaign.trial import Finding

ENOUGH_HOURS = 5.0
"""From so many hours on a rate of rare events is judged as a rate."""
JUDGED_LOSS = "30_pct"
PROMISED = (
    "missions",
    "violations",
    "fence_breaches",
    "closest_approach_m",
    "override_late_frames",
    "max_gap_s",
)
"""Figures that every report has; null where nothing of their part was flown."""


def judge(tally: Tally) -> None:
    """Add what the sums show."""
    sums = tally.sums
    hours = sums.get(f"hours_{JUDGED_LOSS}", 0.0)
    lost = sums.get(f"false_losses_{JUDGED_LOSS}", 0.0)
    allowed = MOST_FALSE_LOSSES_PER_10_H * max(hours, ENOUGH_HOURS) / 10.0
    if lost and lost >= allowed:
        what = f"{lost:.0f} links falsely declared lost in {hours:.1f} h at 30 % loss"
        tally.findings.append(Finding("gaps", what))


def report(tally: Tally, facts: Mapping[str, object], command: str) -> dict[str, object]:
    """The campaign as one JSON object.

    Args:
        tally: Of all trials.
        facts: What was run: its size, seed and duration.
        command: How a trial is replayed, to be completed by its name.
    """
    figures = {
        name: int(value) if value == int(value) and abs(value) < 1e15 else round(value, 6)
        for name, value in sorted(tally.figures().items())
    }
    findings = [
        {"trial": each.trial, "what": each.what, "replay": f"{command} {each.trial}"}
        for each in tally.findings
    ]
    reached_in = dict(sorted(tally.reached_in.items()))
    figures_of_all = {**facts, **dict.fromkeys(PROMISED), **figures}
    return {**figures_of_all, "reached_in": reached_in, "findings": findings}
