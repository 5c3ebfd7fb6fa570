"""Which flavours there are."""

from __future__ import annotations

import numpy as np

from sim_link.autopilot.aircraft import Aircraft
from sim_link.autopilot.flavours.ardupilot.flavour import ArduPilotFlavour
from sim_link.autopilot.flavours.ardupilot.parameters import ardupilot_parameters
from sim_link.autopilot.flavours.base import Flavour
from sim_link.autopilot.flavours.px4.flavour import Px4Flavour
from sim_link.autopilot.flavours.px4.parameters import px4_parameters
from sim_link.autopilot.scenario import Scenario
from sim_link.world.point_mass import PointMass


def make_flavour(
    scenario: Scenario, noise_rng: np.random.Generator, body: PointMass | None = None
) -> Flavour:
    """The scenario's autopilot, on an aircraft of its own.

    Args:
        scenario: Place, limits and configuration.
        noise_rng: Generator of noise, drift and gusts.
        body: What restarts where it is; None: a new one, at the scenario's start.

    Raises:
        ConfigError: The scenario sets a parameter that does not exist, or to what may not be.
    """
    if scenario.autopilot.flavour == "ardupilot":
        first = ArduPilotFlavour.rules.first_mission_item
        return ArduPilotFlavour(
            Aircraft(scenario, noise_rng, first, body), ardupilot_parameters(scenario)
        )
    return Px4Flavour(Aircraft(scenario, noise_rng, body=body), px4_parameters(scenario))
