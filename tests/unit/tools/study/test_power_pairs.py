"""Pairs of flights without and with received power, and their table."""

from __future__ import annotations

import math

import msgspec

from tools.study.power_pairs import POWER_AT_1M_DBM, WRONG_BY_DB, PowerPair, pair_of, table_of_power
from tools.study.study import FlightRow

ROW = FlightRow(
    radio="phone_ftm",
    config="configured",
    planner="latched_crossing",
    seed=1,
    is_reported=True,
    time_s=80.0,
    state="localised",
    error_m=2.0,
    absolute_error_m=3.0,
    r95_m=4.0,
    absolute_r95_m=5.0,
    east_m=10.0,
    north_m=20.0,
    flown_m=300.0,
)


def _pairs(errors_m: list[float]) -> list[PowerPair]:
    changed = (msgspec.structs.replace(ROW, error_m=error_m) for error_m in errors_m)
    return [PowerPair(ROW, row) for row in changed]


def test_two_flights_differ_in_the_configured_power_alone() -> None:
    ranges, powers = pair_of(2, seed=3)
    assert ranges.scenario == powers.scenario
    assert ranges.seed == powers.seed == 3_000_002
    assert ranges.config.estimation.filter.power_at_1m_dbm is None
    with_power = powers.config.estimation.filter
    assert with_power.power_at_1m_dbm == POWER_AT_1M_DBM
    assert ranges.config.estimation.filter == msgspec.structs.replace(
        with_power, power_at_1m_dbm=None
    )


def test_the_configured_power_is_wrong_by_another_amount_in_each_flight() -> None:
    at_1m_dbm = []
    for number in range(4):
        loss = pair_of(number, seed=3)[0].scenario.channel.loss
        assert loss is not None
        reported_dbm = loss.reported_dbm(10.0 * loss.exponent * math.log10(loss.half_range_m))
        assert reported_dbm is not None
        at_1m_dbm.append(reported_dbm)
    assert len(set(at_1m_dbm)) == 4
    assert all(abs(dbm - POWER_AT_1M_DBM) <= WRONG_BY_DB + 0.5 for dbm in at_1m_dbm)


def test_power_that_makes_most_flights_worse_is_seen() -> None:
    assert table_of_power(_pairs([1.9, 2.1] * 10))[1]
    assert table_of_power(_pairs([1.9] * 20))[1]
    assert not table_of_power(_pairs([2.1] * 16 + [1.9] * 4))[1]


def test_so_are_radii_that_do_not_hold() -> None:
    table, is_met = table_of_power(_pairs([1.0] * 20 + [9.0] * 6))
    assert "outside R95             0.00          6.00       0       6" in table
    assert not is_met
