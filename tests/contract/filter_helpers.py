"""All filters, their variants, and what is measured for them.

A filter of `RECURSIVE` joins by itself; what cannot be promised by a baseline (robustness, say) is
tested on those that do.
"""

from __future__ import annotations

import importlib.util
import math

import msgspec
import numpy as np
import pytest

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.filters.target_filter import FilterParams, FilterState, UpdateReport
from companion.estimation.measurement_model import predicted
from companion.kernel import Vector
from tests.contract.hostile_sequences import MakeFilter, fault_of
from tools.study.admm_ekf import RECURSIVE

FILTERPY = "tests.oracle.filterpy_ekf"


def filters() -> dict[str, MakeFilter]:
    """Return all filters, the third-party one if it is installed."""
    makers: dict[str, MakeFilter] = dict(RECURSIVE)
    if importlib.util.find_spec("filterpy"):
        makers["filterpy"] = importlib.import_module(FILTERPY).FilterpyEkf
    return makers


FILTERS = filters()
ROBUST = ["huber", "asymmetric_huber", "admm"]
ONE_SIDED = ["asymmetric_huber", "admm"]
OF_FILTERPY = pytest.mark.filterwarnings("ignore:An ill-conditioned matrix detected")
"""Scipy's warning on the inverse that filterpy takes; its promises hold none the less."""
SPACE = FilterParams(target_height_m=3.0, target_height_sigma_m=4.0)
BOUNDED = FilterParams(
    range_offset_min_m=0.0,
    range_offset_max_m=3.0,
    bearing_offset_max_deg=3.0,
    range_scale_sigma=0.05,
    range_scale_max=0.04,
)
VARIANTS: dict[str, FilterParams] = {
    "one-sided": FilterParams(),
    "symmetric": FilterParams(range_k_short=1.5),
    "asymmetric": FilterParams(range_k_short=3.0),
    "quadratic": FilterParams(range_k_long=None, bearing_k=None),
    "as printed": FilterParams(near_target_terms=False, own_position_sigma_m=0.0),
    "bounded": BOUNDED,
    "moving": FilterParams(process_noise_m_per_sqrt_s=0.5),
    "scaled": FilterParams(range_scale_sigma=0.05),
    "space": SPACE,
    "space, moving": msgspec.structs.replace(SPACE, process_noise_m_per_sqrt_s=0.5),
    "space, scaled": msgspec.structs.replace(SPACE, range_scale_sigma=0.05),
}


def state_of(params: FilterParams, position_sigma_m: float = 30.0) -> FilterState:
    """A target at (40, 20), not sure of it, the other components as they are at first."""
    mean, sigmas = params.prior
    mean[:2] = 40.0, 20.0
    mean[2:4] += [1.0, 0.01]
    sigmas[:2] = position_sigma_m
    return FilterState.of(0.0, mean, np.diag(sigmas**2))


def sure_state(params: FilterParams) -> FilterState:
    """The same target after many measurements: an error is more likely the radio's."""
    state = state_of(params, 1.0)
    return FilterState.of(0.0, state.mean, np.diag(np.minimum(np.diag(state.covariance), 1e-2)))


def seen_at(
    time_s: float,
    range_m: float | None = 50.0,
    bearing_rad: float | None = 0.4,
    elevation_rad: float | None = None,
) -> RangingMeasurement:
    return RangingMeasurement(
        emitter_id=1,
        measured_at_s=time_s,
        range_m=range_m,
        bearing_enu_rad=bearing_rad,
        elevation_rad=elevation_rad,
    )


def expected_by(
    state: FilterState, position: PositionEnu, params: FilterParams, error: Vector | None = None
) -> RangingMeasurement:
    """Return the measurement that a state predicts, plus an error."""
    z = predicted(state.mean, np.array(position), params.model) + (0.0 if error is None else error)
    bearing_rad = math.remainder(float(z[1]), 2.0 * math.pi)
    return seen_at(state.time_s, float(z[0]), bearing_rad, float(z[2]))


def moved_m(report: UpdateReport, state: FilterState) -> float:
    return math.dist(report.state.mean[:2], state.mean[:2])


def assert_sane(report: UpdateReport, prior: FilterState, params: FilterParams) -> None:
    """Symmetric, positive definite, within bounds, and in no direction more uncertain."""
    assert report.is_positive_definite
    assert fault_of(report, prior, params.bounds) is None
    units = 1.0 / np.sqrt(np.diag(prior.covariance))
    learnt = (prior.covariance - report.state.covariance) * np.outer(units, units)
    assert np.linalg.eigvalsh(learnt)[0] > -1e-9


def assert_same(one: FilterState, other: FilterState) -> None:
    """Bit for bit."""
    assert one.mean.tobytes() == other.mean.tobytes()
    assert one.covariance.tobytes() == other.covariance.tobytes()


def surprises(count: int) -> list[tuple[RangingMeasurement, PositionEnu]]:
    """Measurements from anywhere, of anything."""
    rng, drawn = np.random.default_rng(11), []
    for step in range(count):
        position = (*rng.uniform(-60.0, 60.0, 2), 20.0)
        bearing_rad, up_rad = rng.uniform(-3.0, 3.0), rng.uniform(-1.5, 0.5)
        seen = seen_at(float(step), rng.uniform(1.0, 150.0), bearing_rad, up_rad)
        drawn.append((seen, position))
    return drawn
