"""Runs rules against a peer and says how each went."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from fnmatch import fnmatchcase
from typing import Any

from sim_link.conformance.rules import (
    Effect,
    Flavour,
    NotApplicable,
    Role,
    Rule,
    Violation,
)


class Verdict(Enum):
    """How a rule went."""

    PASS = "PASS"
    FAIL = "FAIL"
    SKIP = "SKIP"


@dataclass(frozen=True, slots=True)
class Outcome:
    """A rule and how it went."""

    rule: Rule
    verdict: Verdict
    detail: str = ""
    """Why it failed or was left out."""
    duration_s: float = 0.0
    """Time of the link that it took."""


def select(rules: Iterable[Rule], role: Role, pattern: str | None = None) -> list[Rule]:
    """The rules of a role whose id or group matches a pattern (`*` and `?` are wildcards).

    A pattern without wildcards also selects every id that begins with it.
    """
    chosen = [rule for rule in rules if rule.role is role]
    if pattern is None:
        return chosen
    return [
        rule
        for rule in chosen
        if fnmatchcase(rule.rule_id, pattern) or rule.rule_id.startswith(pattern)
    ]


def try_rule(rule: Rule, probe: Any) -> Outcome:
    """Try one rule with an attached probe; exceptions other than the verdicts are ours."""
    started_s = probe.now_s
    verdict, detail = Verdict.PASS, ""
    try:
        rule.probe(probe)
    except Violation as violation:
        verdict, detail = Verdict.FAIL, str(violation)
    except NotApplicable as reason:
        verdict, detail = Verdict.SKIP, str(reason)
    return Outcome(rule, verdict, detail, probe.now_s - started_s)


def run_rules(
    rules: Iterable[Rule],
    flavour: Flavour,
    allowed: Effect,
    make_probe: Callable[[], Any],
) -> Iterator[Outcome]:
    """Try rules one after another.

    Args:
        rules: Which.
        flavour: Of the vehicle, under test or shown.
        allowed: The most that may be done to it.
        make_probe: An attached probe for each rule.
    """
    base: tuple[int, int] | None = None
    for rule in rules:
        if flavour not in rule.flavours:
            continue
        if not rule.effect.is_within(allowed):
            flag = "--allow-flight" if rule.effect is Effect.FLIES else "--allow-changes"
            yield Outcome(rule, Verdict.SKIP, f"needs {flag}")
            continue
        probe = make_probe()
        outcome = try_rule(rule, probe)
        if rule.effect is Effect.FLIES:
            with suppress(Violation, NotApplicable):
                base = probe.come_to_rest(base)
        yield outcome
