"""Outcomes as lines for people and as JSON for tools."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

from sim_link.conformance.rules import Rule
from sim_link.conformance.runner import Outcome, Verdict


def line(outcome: Outcome) -> str:
    """One rule: its verdict, id and source, and why it failed or was left out."""
    rule = outcome.rule
    text = f"{outcome.verdict.value}  {rule.rule_id}  [{rule.source}]"
    return f"{text}\n      {outcome.detail}" if outcome.detail else text


def summary(outcomes: Sequence[Outcome]) -> str:
    """The closing line."""
    counts = Counter(outcome.verdict for outcome in outcomes)
    text = f"{counts[Verdict.PASS]} passed, {counts[Verdict.FAIL]} failed"
    return f"{text}, {counts[Verdict.SKIP]} skipped" if counts[Verdict.SKIP] else text


def listing(rules: Iterable[Rule]) -> list[str]:
    """The rules in words: what they ask, of whom, from where, and each flavour's deviation."""
    lines = []
    for rule in rules:
        flavours = ", ".join(sorted(flavour.value for flavour in rule.flavours))
        lines.append(f"{rule.rule_id}  ({flavours}; {rule.effect.value})")
        lines.append(f"    {rule.statement}")
        lines.append(f"    source: {rule.source}")
        lines += [f"    {flavour.value}: {text}" for flavour, text in rule.deviations.items()]
    return lines


def record(outcomes: Iterable[Outcome], peer: str) -> dict[str, object]:
    """All outcomes as JSON values.

    Args:
        outcomes: What to tell.
        peer: Against whom they were found.
    """
    told = list(outcomes)
    return {
        "peer": peer,
        "summary": summary(told),
        "rules": [
            {
                "id": outcome.rule.rule_id,
                "statement": outcome.rule.statement,
                "source": outcome.rule.source,
                "verdict": outcome.verdict.value,
                "detail": outcome.detail,
                "duration_s": round(outcome.duration_s, 3),
            }
            for outcome in told
        ],
    }
