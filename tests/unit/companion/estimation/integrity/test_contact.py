"""Ages by kind, and how many measurements agreed since the last gap."""

from __future__ import annotations

from companion.estimation.innovations import OPEN, Gate
from companion.estimation.integrity import Contact
from companion.estimation.window.shared_errors import GAP_S

SHORT = Gate(passes_range=False, agrees_in_range=False)
ASIDE = Gate(passes_bearing=False, agrees_in_bearing=False)


BOTH = (True, True, False)


def _heard(*times_s: float) -> Contact:
    contact = Contact()
    for time_s in times_s:
        contact = contact.after(time_s, BOTH, OPEN)
    return contact


def test_before_the_first_measurement_nothing_has_an_age() -> None:
    contact = Contact()
    assert contact.range_age_s(5.0) is None
    assert contact.bearing_age_s(5.0) is None
    assert contact.is_interrupted(5.0)
    assert contact.agreeing_since_gap(5.0) == 0


def test_each_kind_ages_by_itself() -> None:
    contact = _heard(1.0)
    contact = contact.after(2.0, (True, False, False), OPEN)
    contact = contact.after(2.5, (False, True, False), OPEN)
    assert contact.range_age_s(3.0) == 1.0
    assert contact.bearing_age_s(3.0) == 0.5


def test_what_does_not_agree_makes_nothing_younger() -> None:
    contact = _heard(1.0).after(2.0, BOTH, SHORT)
    assert contact.range_age_s(3.0) == 2.0
    assert contact.bearing_age_s(3.0) == 1.0
    assert contact.agreeing == 1
    nothing = Gate(agrees_in_range=False, agrees_in_bearing=False)
    assert contact.after(2.9, BOTH, nothing) == contact


def test_a_late_one_makes_nothing_older() -> None:
    contact = _heard(1.0, 3.0, 2.2)
    assert contact.range_age_s(3.5) == 0.5
    assert contact.agreeing == 3


def test_after_a_gap_they_are_counted_again() -> None:
    contact = _heard(1.0, 1.1, 1.2)
    assert contact.agreeing_since_gap(1.2 + GAP_S) == 3
    assert contact.agreeing_since_gap(1.2 + GAP_S + 0.1) == 0
    assert contact.is_interrupted(1.2 + GAP_S + 0.1)
    back = contact.after(5.0, BOTH, OPEN).after(5.1, BOTH, OPEN)
    assert back.agreeing_since_gap(5.1) == 2
    half = contact.after(5.0, BOTH, ASIDE).after(5.1, BOTH, OPEN)
    assert half.agreeing_since_gap(5.1) == 1
