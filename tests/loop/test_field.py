"""A radio and a navigation as they are in the field: a flight stays safe, and errs as it must."""

from __future__ import annotations

from itertools import groupby
from pathlib import Path
from typing import Any

import msgspec
import pytest

from companion.config.schema import PlannerConfig, load_config
from companion.estimation.antenna import AntennaParams
from companion.estimation.filters.target_filter import FilterConfig
from companion.estimation.tracker_params import EstimationConfig
from companion.guidance.phases import Phase
from companion.planning.crossing import LatchedCrossingParams
from sim_link.autopilot.estimator import NavigationParams
from sim_link.autopilot.scenario import PayloadParams, Scenario
from sim_link.fleet import load_scenario
from sim_link.world.environment import EmitterParams, FieldChannelParams
from sim_link.world.radio_channel import AntennaModelParams
from tests.loop.loop_helpers import AUTO, Loop

CONFIGS = Path(__file__).parents[2] / "configs"
FIELD = sorted((CONFIGS / "scenarios" / "field").glob("*.yaml"))
CLEAR = FieldChannelParams(
    range_offset_m=0.0, bearing_offset_deg=0.0, p_nlos=0.0, range_sigma_m=0.5, bearing_sigma_deg=1.0
)
NEAR = EmitterParams(position_enu_m=(35.0, 30.0))


def test_what_is_found_is_off_by_the_vehicles_own_error() -> None:
    """A constant error of the position is in the result to the full, and no radio shows it."""
    wrong = NavigationParams(sigma_m=8.0, time_constant_s=1e6)
    scenario = Scenario(
        emitter=NEAR, channel=CLEAR, navigation=wrong, payload=PayloadParams(rate_hz=10.0)
    )
    loop = Loop(config=AUTO, scenario=scenario, seed=1)
    loop.run_until(lambda: bool(loop.notes.results), 120.0)
    east, north, _ = loop.sim.vehicle.estimator.bias_enu_m
    found = loop.notes.results[-1][1].estimate.position_enu_m
    off = (found[0] - 35.0, found[1] - 30.0)
    assert abs(east) + abs(north) > 1.0
    assert off == pytest.approx((east, north), abs=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("path", FIELD, ids=lambda path: path.stem)
def test_the_search_goes_on_safely_whatever_the_radio_says(path: Path) -> None:
    loop = Loop(config=AUTO, scenario=load_scenario(path), seed=1)
    loop.run(90.0)
    assert loop.sim.vehicle.is_armed
    assert loop.phase in (Phase.NORMAL, Phase.DEGRADED, Phase.HOLD, Phase.FINISHED)
    heights = [position[2] for position in loop.true_positions[-500:]]
    assert min(heights) > 3.0


def test_a_second_place_that_flickers_is_announced_once() -> None:
    path = CONFIGS / "scenarios" / "field" / "phone_cellular.yaml"
    config = load_config(CONFIGS / "companion" / "field" / "phone_cellular.yaml")
    mission = msgspec.structs.replace(config.mission, engage="auto")
    config = msgspec.structs.replace(config, mission=mission)
    loop = Loop(config=config, scenario=load_scenario(path), seed=4)
    shown = []
    for _ in range(70):
        loop.run(0.5)
        estimate = loop.companion.session.status(loop.now_s).estimate
        shown.append(None if estimate is None else estimate.state.value)
    states = [fields["state"] for _, kind, fields in loop.notes.records if kind == "estimate"]
    assert changes(states).count("ambiguous") >= 3
    announced = [text.partition(":")[0] for _, text in loop.notes.texts]
    assert [word for word in announced if word in states] == ["searching", "ambiguous"]
    assert changes(shown) == [None, "searching", "ambiguous"]


def changes(states: list[Any]) -> list[Any]:
    """Each state once for every time it began."""
    return [state for state, _ in groupby(states)]


@pytest.mark.slow
def test_an_array_is_crossed_lower_where_that_tells_more_and_never_below_the_band() -> None:
    """It is announced; the report comes from down there, and the climb back is not ours."""
    array = AntennaModelParams(kind="planar")
    scenario = Scenario(emitter=NEAR, channel=CLEAR, payload=PayloadParams(antenna=array))
    believed = FilterConfig(antenna=AntennaParams(kind="planar"))
    planner = PlannerConfig(latched_crossing=LatchedCrossingParams(descend=True))
    estimation = EstimationConfig(filter=believed)
    exacting = msgspec.structs.replace(AUTO.mission, stop_radius_m=0.5)
    config = msgspec.structs.replace(AUTO, estimation=estimation, planner=planner, mission=exacting)
    loop = Loop(config=config, scenario=scenario, seed=1)
    loop.run_until(lambda: bool(loop.notes.results), 120.0)
    assert loop.said("lower pass: 14 m below the search altitude")
    least_m, _ = config.limits.guard_limits().altitude_m
    flown = [sent.position_enu_m[2] for sent in loop.setpoints if sent.time_s > 25.0]
    assert min(flown) == pytest.approx(least_m, abs=0.01)
    assert loop.error_m < 0.5
