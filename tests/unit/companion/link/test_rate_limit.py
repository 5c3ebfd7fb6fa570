from __future__ import annotations

import pytest

from companion.link.intake import RateLimit


def test_a_burst_passes_and_then_so_many_a_second() -> None:
    limit = RateLimit(per_s=2.0, burst=3)
    assert [limit.acquire(0.0) for _ in range(5)] == [True, True, True, False, False]
    passed = sum(limit.acquire(0.1 * tenth) for tenth in range(1, 101))
    assert passed == 20
    assert limit.refused == 2 + 80


def test_what_is_not_used_does_not_pile_up() -> None:
    limit = RateLimit(per_s=1.0, burst=2)
    limit.acquire(0.0)
    assert sum(limit.acquire(1000.0) for _ in range(10)) == 2


def test_a_clock_that_stands_still_or_goes_back_gives_nothing() -> None:
    limit = RateLimit(per_s=1.0)
    assert limit.acquire(5.0)
    assert not limit.acquire(5.0)
    assert not limit.acquire(-100.0)
    assert limit.acquire(6.0)


@pytest.mark.parametrize("waited_s", [0.9, 1.0])
def test_the_next_comes_after_a_whole_one_is_back(waited_s: float) -> None:
    limit = RateLimit(per_s=1.0)
    limit.acquire(0.0)
    assert limit.acquire(waited_s) is (waited_s >= 1.0)
