"""Information of a leg, against numerical integration of the filter's model; its overshoot."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config.schema import CompanionConfig
from companion.estimation.antenna import AntennaKind, AntennaParams
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.measurement_model import DB_PER_NEPER, POWER, jacobian
from companion.estimation.tracker_params import TrackerParams
from companion.flight_setup import build_planner
from companion.kernel import Vector
from companion.planning.crossing import LatchedCrossing
from companion.planning.views import (
    MIN_HEIGHT_M,
    Antenna,
    LegView,
    best_reach_m,
    information,
    leg_over,
    marginal,
    rate,
)

Mount = tuple[float, float, float]
DOWN, AHEAD = (0.0, -90.0, 0.0), (0.0, 0.0, 0.0)
MOUNTS: list[tuple[AntennaKind, Mount, float]] = [
    ("planar", AHEAD, 360.0),
    ("line", AHEAD, 360.0),
    ("line", AHEAD, 120.0),
    ("two_axis", DOWN, 120.0),
    ("two_axis", AHEAD, 100.0),
    ("two_axis", (0.0, -40.0, 0.0), 90.0),
    ("line", (20.0, -60.0, 30.0), 140.0),
]


def _config(kind: AntennaKind, mount: Mount, view_deg: float) -> CompanionConfig:
    antenna = AntennaParams(kind=kind, mount_deg=mount, field_of_view_deg=view_deg)
    return CompanionConfig(estimation=TrackerParams(filter=FilterParams(antenna=antenna)))


def _antenna(kind: AntennaKind, mount: Mount = AHEAD, view_deg: float = 360.0) -> Antenna:
    planner: Any = build_planner(_config(kind, mount, view_deg))
    assert isinstance(planner, LatchedCrossing)
    assert planner._sensor is not None
    return planner._sensor.antenna


def _leg(
    antenna: Antenna,
    height_m: float = 20.0,
    range_m: float = 1.5,
    cosine_rad: float = 0.05,
    yaw_rad: float = 0.0,
    turn_m: float = 10.0,
    share: float = math.inf,
) -> LegView:
    return leg_over(height_m, turn_m, (range_m, cosine_rad, share), antenna, yaw_rad)


def _turned(axis: Mount, yaw_rad: float) -> Vector:
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([c * axis[0] - s * axis[1], s * axis[0] + c * axis[1], axis[2]])


def _information(
    antenna: Antenna, d_m: float, height_m: float, range_m: float, cosine_rad: float, yaw_rad: float
) -> float:
    """Trace of the information about the position by the filter's own Jacobian, leg along east."""
    first, second = (_turned(axis, yaw_rad) for axis in (antenna.first, antenna.second))
    model = FilterParams(antenna=AntennaParams(kind="two_axis")).model
    pose = np.concatenate([[-d_m, 0.0, height_m], first, second])
    H = jacobian(np.zeros(4), pose, model)[:, :2]
    u = np.array([d_m, 0.0, -height_m]) / math.hypot(d_m, height_m)
    of_range = float(H[0] @ H[0]) / range_m**2
    if antenna.is_planar:
        x, y = float(first @ u), float(second @ u)
        row = (x * H[2] - y * H[1]) / (x * x + y * y)
        return of_range + float(row @ row) * (x * x + y * y) / cosine_rad**2
    if abs(_turned(antenna.boresight, yaw_rad) @ u) < math.cos(antenna.half_view_rad):
        return of_range
    rows = H[1 : 1 + antenna.rows]
    return of_range + float((rows * rows).sum()) / cosine_rad**2


@pytest.mark.parametrize(("kind", "mount", "view_deg"), MOUNTS)
@pytest.mark.parametrize("yaw_deg", [0.0, 35.0, 90.0, 200.0])
def test_the_closed_form_is_the_integral_of_what_the_filters_model_tells(
    kind: AntennaKind, mount: Mount, view_deg: float, yaw_deg: float
) -> None:
    antenna, yaw_rad, reach_m = _antenna(kind, mount, view_deg), math.radians(yaw_deg), 31.0
    leg = _leg(antenna, 12.0, 0.8, 0.05, yaw_rad)
    steps = 2000
    width_m = 2.0 * reach_m / steps
    middles = (np.arange(steps) + 0.5) * width_m - reach_m
    summed = (
        sum(_information(antenna, d, 12.0, 0.8, 0.05, yaw_rad) for d in middles.tolist()) * width_m
    )
    assert information(reach_m, leg) == pytest.approx(summed, rel=2e-3)


@pytest.mark.parametrize(("height_m", "reach_m"), [(20.0, 50.0), (8.0, 3.0)])
def test_the_closed_form_of_powers_is_the_integral_of_the_filters_model(
    height_m: float, reach_m: float
) -> None:
    sigma_db, exponent, steps = 7.6, 2.75, 2000
    model = FilterParams(power_at_1m_dbm=-40.0).model
    mean = np.array([0.0, 0.0, 0.0, 0.0, -40.0, exponent])
    width_m = 2.0 * reach_m / steps
    summed = 0.0
    for d_m in ((np.arange(steps) + 0.5) * width_m - reach_m).tolist():
        row = jacobian(mean, np.array([-d_m, 0.0, height_m]), model)[POWER, :2]
        summed += float(row @ row) / sigma_db**2 * width_m
    share = sigma_db / (DB_PER_NEPER * exponent)
    leg = _leg(_antenna("azimuth"), height_m, math.inf, share=share)
    assert information(reach_m, leg) == pytest.approx(summed, rel=1e-4)
    c, theta = 10.0 * exponent / math.log(10.0), math.atan(reach_m / height_m)
    closed = c**2 / (2.0 * height_m * sigma_db**2) * (theta - math.sin(theta) * math.cos(theta))
    assert summed == pytest.approx(2.0 * closed, rel=1e-4)


def test_powers_alone_are_crossed_at_the_same_width_whatever_their_noise() -> None:
    """With t = L / h and k = turn / h its root is atan t - t / (1 + t^2) = 2 t^2 (t + k) / (1 +
    t^2)^2."""
    reaches_m = [
        best_reach_m(_leg(_antenna("azimuth"), 20.0, math.inf, share=share), 2.0, 80.0)
        for share in (0.1, 0.6)
    ]
    assert reaches_m[0] == pytest.approx(reaches_m[1])
    t = reaches_m[0] / 20.0
    wanted = 2.0 * t * t * (t + 0.5) / (1.0 + t * t) ** 2
    assert math.atan(t) - t / (1.0 + t * t) == pytest.approx(wanted, rel=0.02)
    assert 40.0 < reaches_m[0] < 60.0


legs = st.builds(
    _leg,
    st.sampled_from([_antenna(*each) for each in MOUNTS]),
    st.floats(2.0, 60.0),
    st.floats(0.05, 10.0),
    st.floats(0.01, 0.2),
    st.floats(-math.pi, math.pi),
    st.floats(1.0, 20.0),
    st.one_of(st.just(math.inf), st.floats(0.02, 2.0)),
)


@settings(max_examples=100, deadline=None)
@given(legs, st.floats(0.5, 40.0))
def test_the_marginal_is_the_derivative(leg: LegView, reach_m: float) -> None:
    step_m = 1e-4
    edges = [abs(math.tan(leg.middle_rad + side * leg.half_rad)) for side in (-1.0, 1.0)]
    if any(abs(reach_m - leg.height_m * edge) < 2.0 * step_m for edge in edges):
        return
    around = information(reach_m + step_m, leg) - information(reach_m - step_m, leg)
    expected = around / (2.0 * step_m)
    assert marginal(reach_m, leg) == pytest.approx(expected, rel=1e-4, abs=1e-6)


@settings(max_examples=60, deadline=None)
@given(legs, st.floats(0.5, 5.0), st.floats(6.0, 60.0))
def test_the_overshoot_is_within_its_bounds_and_tells_what_brute_force_finds(
    leg: LegView, least_m: float, most_m: float
) -> None:
    reach_m = best_reach_m(leg, least_m, most_m)
    assert least_m <= reach_m <= most_m
    best = max(rate(each, leg) for each in np.linspace(least_m, most_m, 400).tolist())
    assert rate(reach_m, leg) >= 0.99 * best


def test_bearings_alone_are_crossed_as_wide_as_turning_costs() -> None:
    """With k = turn / height the best L / h is the root of atan t = (t + k) / (1 + t^2)."""
    leg = _leg(_antenna("planar"), 20.0, math.inf, 0.05, turn_m=10.0)
    t = best_reach_m(leg, 2.0, 40.0) / 20.0
    assert math.atan(t) == pytest.approx((t + 0.5) / (1.0 + t * t), abs=5e-3)
    tight = _leg(_antenna("planar"), 20.0, math.inf, 0.05, turn_m=0.01)
    assert best_reach_m(tight, 1.0, 40.0) < 0.2 * 20.0 * t


def test_ranges_alone_want_to_be_seen_from_far_to_the_side() -> None:
    leg = _leg(_antenna("azimuth"), 20.0, 1.5, 0.05)
    assert leg.per_cosine == 0.0
    assert best_reach_m(leg, 2.0, 20.0) == 20.0
    vague = _leg(_antenna("planar"), 20.0, 1.5, 1e9)
    assert best_reach_m(vague, 2.0, 20.0) == pytest.approx(20.0, abs=1e-3)


def test_near_the_ground_a_range_tells_all_and_a_bearing_no_more_than_its_least_height() -> None:
    leg = _leg(_antenna("azimuth"), 0.0, 2.0)
    assert leg.height_m == MIN_HEIGHT_M
    assert information(1000.0, leg) == pytest.approx(2.0 * 1000.0 / 4.0, rel=0.01)
    planar = _leg(_antenna("planar"), 0.0, math.inf, 0.1)
    assert information(1e6, planar) == pytest.approx(math.pi / 0.01, rel=1e-3)


def test_without_measurements_there_is_no_information_but_an_overshoot() -> None:
    leg = _leg(_antenna("line"), 20.0, math.inf, math.inf)
    assert information(20.0, leg) == 0.0
    assert 2.0 <= best_reach_m(leg, 2.0, 20.0) <= 20.0


def test_an_array_that_looks_down_is_not_flown_beyond_its_view() -> None:
    leg = _leg(_antenna("two_axis", DOWN, 90.0), 10.0, math.inf, 0.05, turn_m=2.0)
    assert best_reach_m(leg, 2.0, 60.0) <= 10.001


def test_a_line_abreast_of_the_leg_tells_nothing_across_it() -> None:
    along, abreast = (_leg(_antenna("line"), yaw_rad=yaw) for yaw in (0.0, 0.5 * math.pi))
    assert along.across2 == pytest.approx(1.0)
    assert abreast.across2 == pytest.approx(0.0)
    assert abreast.ahead2 == pytest.approx(1.0)


@settings(max_examples=100, deadline=None)
@given(legs, st.floats(1.1, 4.0))
def test_ranges_and_directions_without_an_edge_of_view_tell_more_from_lower(
    leg: LegView, share: float
) -> None:
    whole = leg._replace(half_rad=0.5 * math.pi, middle_rad=0.0, ahead_up=0.0, up2=0.0)
    lower = whole._replace(height_m=max(whole.height_m / share, MIN_HEIGHT_M))
    high, low = (rate(best_reach_m(each, 1.0, 60.0), each) for each in (whole, lower))
    assert low >= high * (1.0 - 1e-6)
