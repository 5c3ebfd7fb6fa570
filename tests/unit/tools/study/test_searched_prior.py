"""Pairs of first fixes, and their table."""

from __future__ import annotations

import math

import pytest

from companion.search.searched_area import SearchPrior
from tools.study import searched_prior as study
from tools.study.searched_prior import Fix, FixPair, fly_pair, table_of_pairs


def test_a_flight_is_the_same_but_for_the_prior(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "LONGEST_S", 15.0)
    pairs = [pair for number in range(4) if (pair := fly_pair(number, 5)) is not None]
    assert pairs
    assert [fly_pair(pairs[0].flight, 5)] == pairs[:1]
    monkeypatch.setattr(SearchPrior, "log_at", lambda *_: 0.0)
    for pair in pairs:
        even = fly_pair(pair.flight, 5)
        assert even is not None
        assert even.without == pair.without
        assert even.with_prior == even.without


def test_a_later_fix_is_seen() -> None:
    without = Fix(20.0, 30.0, 0.5)
    assert table_of_pairs([FixPair(0, without, Fix(10.0, 30.0, 0.9))])[1]
    assert not table_of_pairs([FixPair(0, without, Fix(10.0, 31.0, 0.9))])[1]
    assert not table_of_pairs([FixPair(0, without, Fix(math.inf, 30.0, 0.9))])[1]
