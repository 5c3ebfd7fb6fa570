"""The bound where it is known in closed form: evenly seen from a circle, and once from right above.

By symmetry nothing that is common to all views, offset, height or compass, moves the position then.
The last view, from right above, has no information on it; it is the time that the bound is of.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import pytest

from companion.estimation.filters.target_filter import FilterParams
from companion.kernel import Matrix
from sim_link.autopilot.estimator import NavigationParams
from sim_link.autopilot.scenario import PayloadParams, Scenario
from sim_link.world.environment import EmitterParams, FieldChannelParams
from sim_link.world.radio_channel import AntennaModelParams
from tools.study.field_bound import bound_m2, median_m

VIEWS, RADIUS_M, HEIGHT_M = 36, 30.0, 40.0
SLANT_M = math.hypot(RADIUS_M, HEIGHT_M)
FLAT = RADIUS_M / SLANT_M
EMITTER = EmitterParams(position_enu_m=(50.0, -20.0), height_m=0.0)
CHANNEL = FieldChannelParams(
    p_nlos=0.4,
    range_bias_mean_m=2.0,
    bearing_bias_sigma_deg=9.0,
    correlation_m=0.0,
    range_sigma_m=0.5,
    bearing_sigma_deg=3.0,
)
RANGES, BEARINGS = 0.5, math.radians(3.0) * SLANT_M
"""Sigma of one view along and across its line; along the ground a range says less."""

PRIORS = FilterParams(
    target_height_sigma_m=2.0, bearing_offset_sigma_deg=5.0, range_offset_sigma_m=1.0
)


def circle() -> Matrix:
    """The way, (VIEWS + 1, 7), level and heading north."""
    way = np.zeros((VIEWS + 1, 7))
    turn = np.linspace(0.0, math.tau, VIEWS, endpoint=False)
    way[:, 0] = 10.0 * np.arange(VIEWS + 1)
    way[:, 1:4] = *EMITTER.position_enu_m, HEIGHT_M
    way[:-1, 1] += RADIUS_M * np.cos(turn)
    way[:-1, 2] += RADIUS_M * np.sin(turn)
    return way


def bound(
    measures: Literal["range", "bearing"],
    *,
    reflects: bool = False,
    own_sigma_m: float = 0.0,
    tau_s: float = 0.1,
) -> Matrix:
    scenario = Scenario(
        emitter=EMITTER,
        channel=CHANNEL,
        payload=PayloadParams(measures=measures, antenna=AntennaModelParams(kind="planar")),
        navigation=NavigationParams(sigma_m=own_sigma_m, time_constant_s=tau_s),
    )
    return bound_m2(circle(), scenario, PRIORS, reflects=reflects)


@pytest.mark.parametrize(("measures", "sigma_m"), [("range", RANGES / FLAT), ("bearing", BEARINGS)])
def test_from_a_circle_every_view_tells_half_of_a_place(
    measures: Literal["range", "bearing"], sigma_m: float
) -> None:
    expected = 2.0 * sigma_m**2 / VIEWS * np.eye(2)
    np.testing.assert_allclose(bound(measures), expected, rtol=1e-5, atol=1e-9)


def test_bends_that_do_not_last_are_noise_in_space_whatever_the_steepness() -> None:
    bent_m2 = BEARINGS**2 + 0.4 * (math.radians(9.0) * SLANT_M) ** 2
    expected = 2.0 * bent_m2 / VIEWS * np.eye(2)
    np.testing.assert_allclose(bound("bearing", reflects=True), expected, rtol=1e-5, atol=1e-9)


def test_reflections_that_do_not_last_are_noise_of_their_variance() -> None:
    excess_m2 = (2.0 * 0.4 - 0.4**2) * 2.0**2
    expected = 2.0 * (0.5**2 + excess_m2) / FLAT**2 / VIEWS * np.eye(2)
    np.testing.assert_allclose(bound("range", reflects=True), expected, rtol=1e-5, atol=1e-9)


def test_an_own_error_that_has_no_memory_moves_every_view_and_the_frame_of_the_last() -> None:
    """The error of a view is the error then less the current one, which all of them share."""
    each_m2 = 0.5**2 + (1.5 * FLAT) ** 2
    expected = (2.0 * each_m2 / FLAT**2 / VIEWS + 1.5**2) * np.eye(2)
    np.testing.assert_allclose(bound("range", own_sigma_m=1.5), expected, rtol=1e-5, atol=1e-9)


def test_an_own_error_that_stays_moves_nothing_in_the_vehicles_own_frame() -> None:
    lasting = bound("range", own_sigma_m=1.5, tau_s=1e9)
    np.testing.assert_allclose(lasting, bound("range"), rtol=1e-3, atol=1e-6)


def test_the_median_of_a_round_gaussian_is_rayleighs() -> None:
    expected = 2.0 * math.sqrt(2.0 * math.log(2.0))
    assert median_m(4.0 * np.eye(2)) == pytest.approx(expected, rel=0.03)
