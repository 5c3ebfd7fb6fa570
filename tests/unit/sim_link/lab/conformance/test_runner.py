"""Selecting and running rules, and reporting their results."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import pytest

from sim_link.lab.conformance.cli import all_rules
from sim_link.lab.conformance.rules import (
    ARDUPILOT,
    AutopilotNotes,
    Effect,
    Flavour,
    Role,
    Rule,
    RuleBook,
    RuleOutcome,
    RuleVerdict,
    Violation,
    assume,
    autopilot_notes,
    exit_code,
    line,
    listing,
    record,
    require,
    select,
    summary,
    try_rule,
)


@dataclass
class FakeProbe:
    role: ClassVar[Role] = Role.VEHICLE
    flavour: Flavour = Flavour.PX4
    now_s: float = 0.0


class Samples(FakeProbe):
    book = RuleBook("samples")

    @book.rule("a page")
    def holds(self) -> None:
        """It holds."""
        if not isinstance(self, Samples):
            raise TypeError("not a probe")
        self.now_s += 2.0

    @book.rule("a page")
    def is_broken(self) -> None:
        """It does not hold."""
        require(self.now_s < 0.0, "seen otherwise")

    @book.rule("a page", effect=Effect.CHANGES, flavours=ARDUPILOT)
    def changes(self) -> None:
        """It changes something."""
        assume(False, "no occasion")

    @book.rule("a page", effect=Effect.FLIES, harms=True)
    def flies(self) -> None:
        """It flies."""
        raise Violation("it fell")


book = Samples.book


def run(flavour: Flavour) -> list[RuleOutcome]:
    return [
        try_rule(rule, rule.book.prober(flavour)) for rule in book.rules if flavour in rule.flavours
    ]


def note_of_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    """A PX4 that is known to break a rule."""
    notes = {"samples.is_broken": "does not"}
    written = AutopilotNotes("7.0", notes, {"samples.holds": "another number"})
    known = {Flavour.PX4: written, Flavour.ARDUPILOT: AutopilotNotes("8.0", {}, {})}
    monkeypatch.setattr("sim_link.lab.conformance.rules.autopilot_notes", lambda: known)


def test_a_known_deviation_is_distinguished_from_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    note_of_broken(monkeypatch)
    outcomes = run(Flavour.PX4)
    assert [o.verdict.value for o in outcomes] == ["PASS", "NOTED", "FAIL"]
    assert outcomes[1].detail == "seen otherwise (px4 7.0: does not)"
    assert summary(outcomes) == "1 passed, 1 failed, 1 deviate as noted"


def test_exit_codes_tell_a_known_deviation_from_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    note_of_broken(monkeypatch)
    passed, noted, failed = run(Flavour.PX4)
    assert [exit_code(each) for each in ([passed], [passed, noted], [noted, failed])] == [0, 3, 1]
    assert exit_code([passed], ["COM_X is not restored"]) == 1


def test_a_mistake_of_the_suite_is_no_failure_of_the_vehicle() -> None:
    outcome = try_rule(book.rules[0], FakeProbe())
    assert (outcome.verdict, outcome.detail) == (RuleVerdict.ERROR, "TypeError: not a probe")


def test_every_note_is_about_a_rule() -> None:
    known = {rule.rule_id for rule in all_rules()}
    for notes in autopilot_notes().values():
        assert set(notes.deviates) | set(notes.asks) <= known


def test_a_rule_is_named_after_its_book_and_probe() -> None:
    first = book.rules[0]
    assert (first.rule_id, first.statement, first.source) == (
        "samples.holds",
        "It holds.",
        "a page",
    )


def test_verdicts() -> None:
    outcomes = run(Flavour.ARDUPILOT)
    assert [o.verdict.value for o in outcomes] == ["PASS", "FAIL", "SKIP", "FAIL"]
    assert outcomes[0].duration_s == 2.0
    assert outcomes[1].detail == "seen otherwise"


def test_a_rule_says_what_allows_it() -> None:
    assert [rule.needs for rule in book.rules] == [
        [],
        [],
        ["--allow-changes"],
        ["--allow-flight", "--allow-harm"],
    ]


@pytest.mark.parametrize(
    ("pattern", "names"),
    [
        (None, ["holds", "is_broken", "changes", "flies"]),
        ("samples.", ["holds", "is_broken", "changes", "flies"]),
        ("samples.fl", ["flies"]),
        ("*broken", ["is_broken"]),
        ("others", []),
    ],
)
def test_select(pattern: str | None, names: list[str]) -> None:
    chosen: list[Rule] = select(book.rules, Role.VEHICLE, pattern)
    assert [rule.rule_id.removeprefix("samples.") for rule in chosen] == names


def test_select_by_role() -> None:
    assert select(book.rules, Role.COMPANION) == []


def test_lines_and_summary() -> None:
    outcomes = run(Flavour.ARDUPILOT)
    assert line(outcomes[0]) == "PASS  samples.holds  [a page]"
    assert line(outcomes[1]).splitlines()[1].strip() == "seen otherwise"
    assert summary(outcomes[:2]) == "1 passed, 1 failed"
    assert summary(outcomes) == "1 passed, 2 failed, 1 skipped"


def test_listing_tells_deviations(monkeypatch: pytest.MonkeyPatch) -> None:
    note_of_broken(monkeypatch)
    text = "\n".join(listing(book.rules))
    assert "samples.changes  (ardupilot; changes)" in text
    assert "    deviates: px4 7.0: does not" in text
    assert "    px4: another number" in text


def test_record() -> None:
    written = record(run(Flavour.PX4), "udp:127.0.0.1:1", ["COM_X is not restored"])
    assert written["peer"] == "udp:127.0.0.1:1"
    rules = written["rules"]
    assert isinstance(rules, list)
    assert rules[1]["verdict"] == RuleVerdict.FAIL.value
    assert written["exit_code"] == 1
    assert written["problems"] == ["COM_X is not restored"]
