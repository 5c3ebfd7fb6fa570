"""A reported position is where the autopilot's own map has it, whatever its projection."""

from __future__ import annotations

import math

import pytest

from companion.geometry.coordinates import Projection
from sim_link.autopilot.scenario import PROJECTION_OF, AutopilotParams, FlavourName, Scenario
from sim_link.world.environment import EmitterParams
from tests.loop.loop_helpers import AUTO, Loop

pytestmark = pytest.mark.slow

FAR_AWAY = (700.0, -700.0, 0.0)
NEAR_M = 0.02


def searched(flavour: FlavourName) -> Loop:
    """A whole search, of an emitter as far away as the fence allows."""
    emitter = EmitterParams(position_enu_m=(110.0, 90.0))
    loop = Loop(AUTO, Scenario(autopilot=AutopilotParams(flavour=flavour), emitter=emitter))
    loop.run_until(lambda: bool(loop.notes.results), 240.0)
    return loop


def off_m(loop: Loop) -> float:
    """Return how far apart, m, companion and autopilot have a position a kilometre away."""
    origin, true = loop.companion.session.vehicle.origin, loop.sim.vehicle.origin
    assert origin is not None
    return math.dist(origin.enu_from_geodetic(*true.geodetic_from_enu(FAR_AWAY)), FAR_AWAY)


def check_report(loop: Loop) -> None:
    """The reported degrees are the autopilot's own of the estimate."""
    ((_, result),) = loop.notes.results
    true, (east_m, north_m) = loop.sim.vehicle.origin, result.estimate.position_enu_m
    assert result.latitude_deg is not None
    assert result.longitude_deg is not None
    position = true.enu_from_geodetic(result.latitude_deg, result.longitude_deg, true.altitude_m)
    assert math.dist(position[:2], (east_m, north_m)) <= NEAR_M


@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_the_projection_that_is_expected_is_right_without_a_word(flavour: FlavourName) -> None:
    loop = searched(flavour)
    assert off_m(loop) <= NEAR_M
    check_report(loop)
    assert not loop.said("using the fitted transform")


@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_another_projection_is_reported_once_and_places_are_right_a_kilometre_away(
    flavour: FlavourName, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(PROJECTION_OF, flavour, Projection.ELLIPSOID)
    loop = searched(flavour)
    assert off_m(loop) <= NEAR_M
    check_report(loop)
    texts = [text for _, text in loop.notes.texts if "using the fitted transform" in text]
    assert len(texts) == 1
