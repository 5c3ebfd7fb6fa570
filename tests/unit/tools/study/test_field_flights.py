"""Flights in the field: values drawn by the seed, the flights, and their results."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
import numpy as np
import pytest

from companion.config.schema import CompanionConfig
from companion.errors import ConfigError
from sim_link.autopilot.estimator import NavigationParams
from sim_link.autopilot.scenario import Scenario
from tools.study.field_flights import flights_of, fly
from tools.study.study import FlightGrid, FlightRow

CONFIGS = Path(__file__).parents[4] / "configs"
GRID = FlightGrid(
    cut_s={"phone_ftm": 300.0, "uwb_two_axis": 240.0},
    planners=("latched_crossing", "lawnmower"),
)


def test_everything_with_each_other_the_seeds_by_turns() -> None:
    flights = flights_of(GRID, CONFIGS, 3, 1)
    assert len(flights) == 3 * 2 * 2 * 2
    assert {flight.seed for flight in flights[:8]} == {1_000_000}
    assert len({flight.key for flight in flights}) == len(flights)


def test_only_what_is_named_is_flown() -> None:
    flights = flights_of(GRID, CONFIGS, 2, 1, ["phone_ftm", "configured"])
    assert {(f.radio, f.config_kind) for f in flights} == {("phone_ftm", "configured")}
    assert {f.config.planner.flown for f in flights} == {"latched_crossing", "lawnmower"}
    with pytest.raises(ConfigError, match=r"--only phone: .*did you mean `phone_ftm`"):
        flights_of(GRID, CONFIGS, 2, 1, ["phone"])


def test_who_does_not_know_the_radio_knows_how_to_search() -> None:
    grid = msgspec.structs.replace(GRID, cut_s={"rubble": 240.0})
    flights = flights_of(grid, CONFIGS, 1, 1, ["latched_crossing"])
    configured, unconfigured = (flight.config for flight in flights)
    assert (flights[0].config_kind, flights[1].config_kind) == ("configured", "unconfigured")
    assert unconfigured.planner == configured.planner
    assert unconfigured.planner.search == "expanding_square"
    assert unconfigured.estimation == CompanionConfig().estimation
    assert unconfigured.mission.stop_radius_m == CompanionConfig().mission.stop_radius_m


def test_the_same_seed_is_the_same_world_for_everybody() -> None:
    flights = flights_of(GRID, CONFIGS, 1, 1, ["phone_ftm"])
    assert len({msgspec.json.encode(flight.scenario) for flight in flights}) == 1
    more = flights_of(GRID, CONFIGS, 2, 1, ["phone_ftm"])
    assert [f.key for f in more[: len(flights)]] == [f.key for f in flights]


def test_places_fill_the_ring_and_constants_keep_their_size() -> None:
    grid = msgspec.structs.replace(GRID, cut_s={"uwb_tag_line": 240.0}, planners=("fim",))
    drawn = [f.scenario for f in flights_of(grid, CONFIGS, 400, 1, ["configured"])]
    ways = [math.dist(s.emitter.position_enu_m, s.start_enu_m) for s in drawn]
    assert 25.0 <= min(ways) < 30.0
    assert 88.0 < max(ways) <= 90.0
    assert np.mean(np.square(ways)) == pytest.approx(0.5 * (25.0**2 + 90.0**2), rel=0.08)
    compass = [s.navigation.compass_error_deg for s in drawn]
    assert np.sqrt(np.mean(np.square(compass))) == pytest.approx(3.0, rel=0.08)
    assert abs(np.mean(compass)) < 0.5
    offsets = [s.channel.range_offset_m for s in drawn]
    assert min(offsets) >= 0.0
    assert np.mean(offsets) == pytest.approx(0.2, rel=0.1)
    winds = [math.hypot(s.wind.east_mps, s.wind.north_mps) for s in drawn]
    assert winds == pytest.approx([4.0] * len(winds))
    heights = [s.emitter.height_m for s in drawn]
    assert max(heights) - min(heights) == pytest.approx(4.0, rel=0.05)


@pytest.mark.slow
def test_a_flight_tells_both_errors_of_its_report() -> None:
    """The canonical radio, with a receiver that is off by metres for the whole flight."""
    flight = flights_of(GRID, CONFIGS, 1, 1, ["phone_ftm", "unconfigured", "latched_crossing"])[0]
    wrong = NavigationParams(sigma_m=5.0, time_constant_s=1e6)
    object.__setattr__(flight, "scenario", Scenario(navigation=wrong))
    row = msgspec.json.decode(fly(flight), type=FlightRow)
    assert row.is_reported
    assert row.error_m is not None
    assert row.absolute_error_m is not None
    assert row.error_m < 0.5
    assert row.absolute_error_m > 1.0
    assert 10.0 < row.time_s < 120.0
