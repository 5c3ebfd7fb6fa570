"""The campaign of clocks: the same flight by the same name, and what is not good is found."""

from __future__ import annotations

from dataclasses import replace

import pytest

from sim_link.autopilot.incidents import ClockRate, ClockSlip
from tools.campaign.clock_campaign import (
    MOST_SLIPS,
    RATES,
    SLIPS_S,
    ClockFlight,
    fly,
    holds_s,
    incidents_of,
    main,
    report,
)

GOOD = ClockFlight("px4", 3, 0.95, ((18.0, 1.0),), 0.2, 2.5, 60.0, ())


def test_a_name_draws_a_rate_and_slips_and_the_same_ones_again() -> None:
    rates, steps = set(), set()
    for seed in range(40):
        rate, *slips = incidents_of(f"px4:{seed}")
        assert [rate, *slips] == incidents_of(f"px4:{seed}")
        assert isinstance(rate, ClockRate)
        assert 1 <= len(slips) <= MOST_SLIPS
        rates.add(rate.rate)
        steps |= {slip.step_s for slip in slips if isinstance(slip, ClockSlip)}
    assert (rates, steps) == (set(RATES), set(SLIPS_S))


def test_a_hold_lasts_until_the_plan_is_flown_or_the_flight_ends() -> None:
    stale, on = "hold: vehicle position is stale", "flying the plan"
    assert holds_s([(1.0, "ready"), (5.0, stale), (7.5, on), (9.0, stale)], 12.0) == [2.5, 3.0]


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"error_m": None}, "nothing reported"),
        ({"error_m": 2.0}, "2.00 m off"),
        ({"longest_hold_s": 6.5}, "held for 6.5 s"),
        ({"farthest_m": 151.0}, "151.0 m away"),
        ({"alarms": ("control yielded",)}, "'control yielded'"),
    ],
)
def test_what_is_not_good_is_told_with_its_command(
    change: dict[str, object], fault: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert report([GOOD, replace(GOOD, **change)]) == 1  # type: ignore[arg-type]
    said = capsys.readouterr().err
    assert f"FOUND {fault}" in said
    assert "--replay px4:3" in said
    assert report([GOOD]) == 0


def test_another_name_is_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--replay", "copter:x"])
    assert ended.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.slow
def test_one_flight_each_is_good() -> None:
    assert [fly(name).faults for name in ("px4:0", "ardupilot:0")] == [[], []]
