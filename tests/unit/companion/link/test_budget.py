from __future__ import annotations

import pytest

from companion.link.intake import (
    KNOWN,
    MAX_SOURCES,
    ONE_UNKNOWN_PEER,
    UNKNOWN_PEERS,
    FloodBudget,
    Resource,
)
from companion.mav.endpoint import Address


def source(number: int) -> Address:
    return (f"10.0.{number // 256}.{number % 256}", 14550)


def passed(
    budget: FloodBudget, resource: Resource, attempts: int, peer: Address, *, is_known: bool = False
) -> int:
    return sum(budget.spend(resource, 1, peer, is_known=is_known) for _ in range(attempts))


@pytest.mark.parametrize("resource", Resource)
def test_the_autopilot_has_a_large_budget_and_a_stranger_a_small_one(resource: Resource) -> None:
    budget = FloodBudget()
    attempts = KNOWN[resource] + 10
    assert passed(budget, resource, attempts, source(0), is_known=True) == KNOWN[resource]
    assert passed(budget, resource, attempts, source(1)) == ONE_UNKNOWN_PEER[resource]
    assert budget.dropped[resource] == 10 + attempts - ONE_UNKNOWN_PEER[resource]


@pytest.mark.parametrize("resource", Resource)
def test_strangers_share_and_never_touch_what_is_the_autopilots(resource: Resource) -> None:
    budget = FloodBudget()
    each = ONE_UNKNOWN_PEER[resource]
    total = sum(passed(budget, resource, each, source(n)) for n in range(1, 20))
    assert total == UNKNOWN_PEERS[resource]
    assert passed(budget, resource, KNOWN[resource], source(0), is_known=True) == KNOWN[resource]


def test_a_loud_stranger_leaves_room_for_a_quiet_one() -> None:
    budget = FloodBudget()
    passed(budget, Resource.FRAMES, 1000, source(1))
    assert budget.spend(Resource.FRAMES, 1, source(2), is_known=False)


def test_of_a_thousand_sources_only_so_many_are_remembered() -> None:
    budget = FloodBudget()
    heard = [budget.spend(Resource.FRAMES, 1, source(n), is_known=False) for n in range(1000)]
    assert sum(heard) == MAX_SOURCES
    assert len(budget._by_source) == MAX_SOURCES


def test_a_datagram_is_taken_whole_or_not_at_all() -> None:
    budget = FloodBudget()
    limit = ONE_UNKNOWN_PEER[Resource.BYTES]
    assert not budget.spend(Resource.BYTES, limit + 1, source(1), is_known=False)
    assert budget.spend(Resource.BYTES, limit, source(1), is_known=False)
    assert not budget.spend(Resource.BYTES, 1, source(1), is_known=False)


def test_every_tick_renews_all_of_it() -> None:
    budget = FloodBudget()
    for _ in range(3):
        assert passed(budget, Resource.FRAMES, 1000, source(1)) == ONE_UNKNOWN_PEER[Resource.FRAMES]
        used = passed(budget, Resource.FRAMES, 9000, source(0), is_known=True)
        assert used == KNOWN[Resource.FRAMES]
        budget.renew()
