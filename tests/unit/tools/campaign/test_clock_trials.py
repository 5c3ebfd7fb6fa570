"""Trials of clocks: the same flight by the same seed, and what is not good is found."""

from __future__ import annotations

import math

import pytest

from sim_link.autopilot.incidents import ClockRate, ClockSlip
from tools.campaign.clock_trials import (
    MAX_SLIPS,
    RATES,
    SLIPS_S,
    faults_of,
    fly,
    holds_s,
    incidents_of,
)
from tools.campaign.flights import Trial


def test_a_seed_draws_a_rate_and_slips_and_the_same_ones_again() -> None:
    rates, steps, counts = set(), set(), set()
    for seed in range(60):
        rate, *slips = incidents_of(seed)
        assert (rate, *slips) == incidents_of(seed)
        assert isinstance(rate, ClockRate)
        rates.add(rate.rate)
        counts.add(len(slips))
        steps |= {slip.step_s for slip in slips if isinstance(slip, ClockSlip)}
    assert (rates, steps) == (set(RATES), set(SLIPS_S))
    assert counts == set(range(1, MAX_SLIPS + 1))


def test_a_hold_lasts_until_the_plan_is_flown_or_the_flight_ends() -> None:
    stale, on = "hold: vehicle position is stale", "following the plan"
    assert holds_s([(1.0, "ready"), (5.0, stale), (7.5, on), (9.0, stale)], 12.0) == [2.5, 3.0]


@pytest.mark.parametrize(
    ("figures", "fault"),
    [
        ((math.inf, 0.0, 0.0, []), "nothing reported"),
        ((2.0, 0.0, 0.0, []), "2.00 m off"),
        ((0.2, 6.5, 0.0, []), "held for 6.5 s"),
        ((0.2, 2.5, 151.0, []), "151.0 m away"),
        ((0.2, 2.5, 60.0, ["hold: control yielded"]), "'control yielded'"),
    ],
)
def test_what_is_not_good_is_a_finding(
    figures: tuple[float, float, float, list[str]], fault: str
) -> None:
    assert faults_of(*figures) == [fault]


def test_a_good_flight_has_none() -> None:
    assert faults_of(0.2, 2.5, 60.0, ["following the plan"]) == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_one_flight_with_each_autopilot_is_good(seed: int) -> None:
    assert fly(Trial("clocks", seed)).findings == ()
