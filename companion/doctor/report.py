"""The findings as lines for people and as JSON."""

from __future__ import annotations

from collections.abc import Sequence

from companion.doctor.verdicts import Finding, Level

SUBJECT_WIDTH = 24


def as_lines(findings: Sequence[Finding]) -> list[str]:
    """A line per finding, one below it for what mends it, and a last one that adds up."""
    lines = []
    for finding in findings:
        lines.append(f"{finding.level.value:<5} {finding.subject:<{SUBJECT_WIDTH}} {finding.text}")
        if finding.fix:
            lines.append(f"{'':<5} {'':<{SUBJECT_WIDTH}} -> {finding.fix}")
    counts = {level: sum(f.level is level for f in findings) for level in Level}
    verdict = "do not fly like this" if counts[Level.FAIL] else "fit to fly"
    counted = f"{counts[Level.OK]} ok, {counts[Level.WARN]} warnings, {counts[Level.FAIL]} failures"
    return [*lines, f"{verdict}: {counted}"]


def as_json(findings: Sequence[Finding]) -> dict[str, object]:
    """Plain values."""
    return {
        "is_fit": not any(finding.level is Level.FAIL for finding in findings),
        "findings": [
            {
                "level": finding.level.value,
                "subject": finding.subject,
                "text": finding.text,
                "fix": finding.fix,
            }
            for finding in findings
        ],
    }
