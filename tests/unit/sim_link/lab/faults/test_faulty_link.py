"""Effect of each link fault on datagrams, against its record."""

from __future__ import annotations

import itertools

import pytest

from sim_link.lab.faults.fault_models import (
    Fault,
    LinkBitFlips,
    LinkBlackout,
    LinkBursts,
    LinkDelay,
    LinkDuplicates,
    LinkGarbage,
    LinkHold,
    LinkJitter,
    LinkLoss,
    LinkRateCap,
    LinkTruncation,
    Schedule,
)
from sim_link.lab.faults.faulty_link import FaultyLink
from sim_link.lab.observer import Delivery, Lane

FRAME = bytes(range(100, 140))
PERIOD_S = 0.01


def carried(
    *faults: Fault, count: int = 4000, lane: Lane = Lane.TO_VEHICLE, seed: int = 1
) -> list[list[Delivery]]:
    """Return the arrivals of this number of datagrams, one every 10 ms."""
    link = FaultyLink(Schedule(faults=faults), seed)
    return [link.carry(FRAME, lane, i * PERIOD_S) for i in range(count)]


def lost_share(arrivals: list[list[Delivery]]) -> float:
    return sum(not each for each in arrivals) / len(arrivals)


def test_a_link_without_faults_delivers_at_once() -> None:
    assert carried(count=3) == [[(i * PERIOD_S, FRAME)] for i in range(3)]


def test_loss_takes_its_share() -> None:
    assert lost_share(carried(LinkLoss(share=0.3))) == pytest.approx(0.3, abs=0.03)


def test_a_blackout_takes_all_while_it_lasts() -> None:
    arrivals = carried(LinkBlackout(start_s=1.0, duration_s=2.0), count=400)
    assert [bool(each) for each in arrivals] == [not 100 <= i < 300 for i in range(400)]


def test_one_direction_leaves_the_other_alone() -> None:
    fault = LinkBlackout(direction="to_companion")
    assert lost_share(carried(fault, count=50)) == 0.0
    assert lost_share(carried(fault, count=50, lane=Lane.TO_COMPANION)) == 1.0
    assert lost_share(carried(LinkBlackout(), count=50, lane=Lane.RANGING)) == 0.0


def test_bursts_lose_neighbours_together() -> None:
    arrivals = carried(LinkBursts(mean_good_s=0.9, mean_bad_s=0.1), count=40_000)
    assert lost_share(arrivals) == pytest.approx(0.1, abs=0.03)
    runs = sum(not a and bool(b) for a, b in itertools.pairwise(arrivals))
    mean_run = sum(not each for each in arrivals) / runs
    assert mean_run == pytest.approx(10.0, rel=0.25)


def test_delay_and_jitter_add_up_and_jitter_reorders() -> None:
    arrivals = carried(LinkDelay(delay_s=0.1), LinkJitter(jitter_s=0.2), count=500)
    lates = [each[0][0] - i * PERIOD_S for i, each in enumerate(arrivals)]
    assert 0.1 <= min(lates) < 0.11
    assert 0.29 < max(lates) <= 0.3
    dues = [each[0][0] for each in arrivals]
    assert dues != sorted(dues)


def test_duplicates_are_copies_that_come_later() -> None:
    arrivals = carried(LinkDuplicates(share=0.25, copies=2, spread_s=0.1))
    doubled = [each for each in arrivals if len(each) > 1]
    assert len(doubled) / len(arrivals) == pytest.approx(0.25, abs=0.03)
    assert {len(each) for each in doubled} == {3}
    assert all(data == FRAME for each in doubled for _, data in each)
    assert all(first[0] <= copy[0] <= first[0] + 0.1 for first, *rest in doubled for copy in rest)


def test_bit_flips_turn_over_as_many_bits_as_they_say() -> None:
    arrivals = carried(LinkBitFlips(share=1.0, bits=1), count=200)
    for ((_, data),) in arrivals:
        turned = int.from_bytes(data, "big") ^ int.from_bytes(FRAME, "big")
        assert turned.bit_count() == 1


def test_truncation_cuts_the_end() -> None:
    arrivals = carried(LinkTruncation(share=1.0), count=200)
    assert all(FRAME.startswith(data) and 1 <= len(data) < 40 for ((_, data),) in arrivals)


def test_garbage_stands_before_the_frame() -> None:
    arrivals = carried(LinkGarbage(share=1.0, most_bytes=10), count=200)
    assert all(data.endswith(FRAME) and 41 <= len(data) <= 50 for ((_, data),) in arrivals)


def test_a_rate_cap_delays_and_then_loses() -> None:
    arrivals = carried(LinkRateCap(bits_per_s=16_000.0, queue_bytes=400), count=1000)
    arrived = [each[0][0] for each in arrivals if each]
    gaps = [b - a for a, b in itertools.pairwise(arrived)]
    assert min(gaps) == pytest.approx(0.02)
    assert lost_share(arrivals) == pytest.approx(0.5, abs=0.02)
    lates = [each[0][0] - i * PERIOD_S for i, each in enumerate(arrivals) if each]
    assert max(lates) <= 0.2 + 0.02 + 1e-9


def test_what_is_held_comes_all_at_once() -> None:
    arrivals = carried(LinkHold(start_s=1.0, duration_s=1.0), count=300)
    assert [each[0][0] for each in arrivals[100:200]] == [2.0] * 100
    assert arrivals[200][0][0] == 2.0


def test_the_same_seed_does_the_same_and_another_does_not() -> None:
    faults: tuple[Fault, ...] = (LinkLoss(share=0.5), LinkBitFlips(share=0.5), LinkJitter())
    assert carried(*faults, count=100) == carried(*faults, count=100)
    assert carried(*faults, count=100) != carried(*faults, count=100, seed=2)


def test_another_fault_changes_nothing_of_what_the_first_one_draws() -> None:
    loss = LinkLoss(share=0.5)
    alone = [bool(each) for each in carried(loss, count=300)]
    beside = [bool(each) for each in carried(loss, LinkBitFlips(share=1.0), count=300)]
    assert alone == beside
