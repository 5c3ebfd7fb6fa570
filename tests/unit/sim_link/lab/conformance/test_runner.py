"""Selecting and running rules, and telling how they went."""

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
    line,
    listing,
    record,
    require,
    run_rules,
    select,
    summary,
)


@dataclass
class FakeProbe:
    role: ClassVar[Role] = Role.VEHICLE
    flavour: Flavour = Flavour.PX4
    now_s: float = 0.0
    rested: int = 0

    def come_to_rest(self, base_e7: tuple[int, int] | None) -> tuple[int, int]:
        self.rested += 1
        return base_e7 or (1, 2)


class Samples(FakeProbe):
    book = RuleBook("samples")

    @book.rule("a page")
    def holds(self) -> None:
        """It holds."""
        self.now_s += 2.0

    @book.rule("a page")
    def is_broken(self) -> None:
        """It does not hold."""
        require(self.now_s < 0.0, "seen otherwise")

    @book.rule("a page", effect=Effect.CHANGES, flavours=ARDUPILOT)
    def changes(self) -> None:
        """It changes something."""
        assume(False, "no occasion")

    @book.rule("a page", effect=Effect.FLIES, says="It flies, and nothing else.")
    def flies(self) -> None:
        """It flies."""
        raise Violation("it fell")


book = Samples.book


def run(flavour: Flavour, allowed: Effect, probe: FakeProbe | None = None) -> list[RuleOutcome]:
    return list(run_rules(book.rules, flavour, allowed, lambda prober: probe or prober()))


def note_of_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    """A PX4 that is known to break a rule."""
    notes = {"samples.is_broken": "does not"}
    told = AutopilotNotes("7.0", notes, {"samples.holds": "another number"})
    known = {Flavour.PX4: told, Flavour.ARDUPILOT: AutopilotNotes("8.0", {}, {})}
    monkeypatch.setattr("sim_link.lab.conformance.rules.autopilot_notes", lambda: known)


def test_a_known_deviation_is_told_apart_from_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    note_of_broken(monkeypatch)
    outcomes = run(Flavour.PX4, Effect.ASKS)
    assert [o.verdict.value for o in outcomes] == ["PASS", "NOTED", "SKIP"]
    assert outcomes[1].detail == "seen otherwise (px4 7.0: does not)"
    assert summary(outcomes) == "1 passed, 0 failed, 1 deviate as noted, 1 skipped"


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
    outcomes = run(Flavour.ARDUPILOT, Effect.FLIES)
    assert [o.verdict.value for o in outcomes] == ["PASS", "FAIL", "SKIP", "FAIL"]
    assert outcomes[0].duration_s == 2.0
    assert outcomes[1].detail == "seen otherwise"


def test_a_statement_may_be_longer_than_a_docstring() -> None:
    assert book.rules[-1].statement == "It flies, and nothing else."


def test_a_rule_of_the_other_flavour_is_left_out() -> None:
    assert [o.rule.rule_id for o in run(Flavour.PX4, Effect.FLIES)] == [
        "samples.holds",
        "samples.is_broken",
        "samples.flies",
    ]


def test_what_is_not_allowed_is_skipped_and_says_how_to_allow_it() -> None:
    outcomes = run(Flavour.ARDUPILOT, Effect.ASKS)
    assert [o.detail for o in outcomes[2:]] == ["needs --allow-changes", "needs --allow-flight"]


def test_a_vehicle_that_flew_is_brought_to_rest() -> None:
    probe = FakeProbe()
    run(Flavour.PX4, Effect.FLIES, probe)
    assert probe.rested == 1


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
    outcomes = run(Flavour.PX4, Effect.FLIES)
    assert line(outcomes[0]) == "PASS  samples.holds  [a page]"
    assert line(outcomes[1]).splitlines()[1].strip() == "seen otherwise"
    assert summary(outcomes[:2]) == "1 passed, 1 failed"
    assert summary(run(Flavour.PX4, Effect.ASKS)) == "1 passed, 1 failed, 1 skipped"


def test_listing_tells_deviations(monkeypatch: pytest.MonkeyPatch) -> None:
    note_of_broken(monkeypatch)
    text = "\n".join(listing(book.rules))
    assert "samples.changes  (ardupilot; changes)" in text
    assert "    deviates: px4 7.0: does not" in text
    assert "    px4: another number" in text


def test_record() -> None:
    told = record(run(Flavour.PX4, Effect.ASKS), "udp:127.0.0.1:1")
    assert told["peer"] == "udp:127.0.0.1:1"
    rules = told["rules"]
    assert isinstance(rules, list)
    assert rules[1]["verdict"] == RuleVerdict.FAIL.value
