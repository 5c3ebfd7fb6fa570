"""Every kernel on seeded inputs, its results saved: run plain and compiled by its test."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from companion.estimation.antenna import AntennaParams, antenna_axes_enu
from companion.estimation.filters.kalman import (
    RecursiveFilter,
    asymmetric_huber_influence,
    asymmetric_huber_loss,
    asymmetric_huber_weight,
    is_positive_definite,
    joseph_row,
    settled,
    within_bounds,
)
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.measurement_model import (
    AZIMUTH,
    innovations,
    jacobian,
    predicted,
    variances,
)
from companion.estimation.number_or_array import wrapped
from companion.estimation.window.map_kernels import (
    clipped,
    map_cost,
    map_descent,
    map_step,
    measured_innovations,
    normal_equations,
    row_partials,
    row_residuals,
    row_sigmas,
)
from companion.kernel import Matrix, Vector, frozen
from sim_link.world.environment import (
    NO_MEMORY,
    Environment,
    ObstacleParams,
    OpenPath,
    ShadowParams,
    obstruction,
    shadow_of,
)
from sim_link.world.line_of_sight import detour, is_blocked, ways_to
from tools.study.admm_ekf import RECURSIVE

LAYOUTS = {
    "plane": FilterParams(range_offset_min_m=0.0, range_offset_max_m=3.0),
    "space": FilterParams(
        range_k_short=3.0,
        bearing_offset_max_deg=3.0,
        range_scale_sigma=0.05,
        range_scale_max=0.04,
        target_height_sigma_m=4.0,
    ),
    "as printed": FilterParams(near_target_terms=False, own_position_sigma_m=0.0),
    "planar": FilterParams(antenna=AntennaParams(kind="planar")),
    "cosines": FilterParams(antenna=AntennaParams(kind="two_axis"), target_height_sigma_m=4.0),
}
SEEDS = 8
IS_COMPILED = "is compiled"
"""Name of the result that states how the kernels were run."""

Results = Iterator[tuple[str, object]]


def losses() -> Results:
    """The loss family at and near its knots."""
    for k_long, k_short in ((1.5, math.inf), (1.5, 1.5), (math.inf, math.inf), (1.0, 3.0)):
        u = [-50.0, -3.0, -1.5, -1e-9, 0.0, 0.3, 1.5, 1.5000001, 200.0]
        for function in (
            asymmetric_huber_loss,
            asymmetric_huber_influence,
            asymmetric_huber_weight,
        ):
            name = getattr(function, "__name__", "")
            yield f"{name} {k_long} {k_short}", [function(v, k_long, k_short) for v in u]


def updates(name: str, params: FilterParams) -> Results:
    """One measurement of everything: its parts, and the whole update of every filter."""
    model, bounds = params.model, params.bounds
    for seed in range(SEEDS):
        rng = np.random.default_rng([1, seed])
        mean, P, sensor, z, sigma = drawn_update(params, rng)
        inflation = np.array([1.0, 4.0, 2.0])
        yield f"{name} {seed} predicted", predicted(mean, sensor, model)
        H = jacobian(mean, sensor, model)
        yield f"{name} {seed} jacobian", H
        yield f"{name} {seed} variances", variances(P, mean, sensor, sigma, model)
        yield f"{name} {seed} innovations", innovations(z, mean, sensor, model)
        K, updated, S = joseph_row(P, H[0].copy(), 2.5)
        yield f"{name} {seed} joseph gain", K
        yield f"{name} {seed} joseph covariance", updated
        yield f"{name} {seed} joseph S", S
        far = mean + 10.0 * np.sqrt(np.diag(P))
        yield f"{name} {seed} within bounds", within_bounds(far, P, bounds[0], bounds[1])
        yield f"{name} {seed} settled", settled(far, P, bounds)
        definite = (is_positive_definite(mean, P), is_positive_definite(mean, -P))
        yield f"{name} {seed} positive definite", definite
        for kind, filter_of in RECURSIVE.items():
            target_filter = filter_of(params)
            assert isinstance(target_filter, RecursiveFilter)
            seen = (frozen(mean), frozen(P), sensor, z, sigma, 0.3, inflation)
            found = target_filter.kernel(*seen, *target_filter.settings)
            for part, value in zip(PARTS, found, strict=True):
                yield f"{name} {seed} {kind}, {part}", value


PARTS = ("mean", "covariance", "report", "is sane")


def drawn_update(
    params: FilterParams, rng: np.random.Generator
) -> tuple[Vector, Matrix, Vector, Vector, Vector]:
    """A correlated state, a sensor, and a measurement with some of its rows missing."""
    mean, sigmas = params.prior
    mean[:2] = rng.uniform(-40.0, 40.0, 2)
    root = np.eye(mean.size) + 0.4 * rng.normal(size=(mean.size, mean.size))
    P = root @ root.T * np.outer(sigmas, sigmas)
    P = 0.5 * (P + P.T)
    sensor = np.array([*rng.uniform(-60.0, 60.0, 2), 20.0, *drawn_axes(params, rng)])
    z = predicted(mean, sensor, params.model) + rng.normal(size=3) * [9.0, 0.4, 0.3]
    z[rng.random(3) < 0.2] = np.nan
    return mean, P, sensor, z, np.array([1.5, 0.03, 0.09])


def drawn_axes(params: FilterParams, rng: np.random.Generator) -> list[float]:
    """Two axes of an antenna that leans anyhow, if there is one."""
    if params.model.antenna == AZIMUTH:
        return []
    attitude_rad = (*rng.uniform(-0.4, 0.4, 2).tolist(), float(rng.uniform(-3.0, 3.0)))
    ahead, right, _ = antenna_axes_enu(attitude_rad, (0.0, 0.0, 0.0))
    return [*ahead, *right]


def windows(name: str, params: FilterParams) -> Results:
    """The MAP problem of a walk: its parts, one step, and the whole solution."""
    model, bounds, thresholds = params.model, params.bounds, params.thresholds
    for seed in range(SEEDS // 2):
        rows, truth = drawn_rows(params, np.random.default_rng([2, seed]))
        start = np.array(truth)
        start[:2] += 8.0, -5.0
        information = np.diag(1.0 / params.prior[1] ** 2)
        pull = 0.1 * np.diag(information)
        sigmas = row_sigmas(rows, start, model)
        u, offs = (
            row_residuals(rows, start, sigmas, model),
            measured_innovations(rows, start, model),
        )
        yield f"{name} {seed} sigmas", sigmas
        yield f"{name} {seed} residuals", u
        yield f"{name} {seed} influences", clipped(u, thresholds)
        yield f"{name} {seed} partials", row_partials(rows, start, sigmas, model)
        prior = (information, pull, model)
        yield f"{name} {seed} cost", map_cost(rows, offs, start, sigmas, thresholds, *prior)
        A, descent, _ = normal_equations(rows, start, offs, sigmas, thresholds, *prior)
        yield f"{name} {seed} normal matrix", A
        yield f"{name} {seed} descent", descent
        moved, _, damping, gain, _ = map_step(rows, start, offs, 1e-3, thresholds, bounds, *prior)
        yield f"{name} {seed} step", moved
        yield f"{name} {seed} damping", damping
        yield f"{name} {seed} gain", gain
        mean, *_ = map_descent(rows, start, 1e-3, 25, thresholds, bounds, *prior)
        yield f"{name} {seed} minimum", mean


def drawn_rows(params: FilterParams, rng: np.random.Generator) -> tuple[Matrix, Vector]:
    """A walk about a target, with reflections and gaps."""
    truth = np.array(params.prior[0])
    truth[:2] = 40.0, 25.0
    rows = np.full((60, 10 + len(drawn_axes(params, rng))), np.nan)
    for index in range(60):
        angle = 0.1 * index
        position = (60.0 * math.cos(angle), 45.0 * math.sin(angle), 20.0)
        sensor = np.array([*position, *drawn_axes(params, rng)])
        z = predicted(truth, sensor, params.model) + rng.normal(size=3) * [1.5, 0.03, 0.09]
        z[0] += rng.exponential(8.0) if rng.random() < 0.4 else 0.0
        z[rng.random(3) < 0.2] = np.nan
        rows[index] = [*position, *z, 1.5, 0.03, 0.09, index, *sensor[3:]]
    return rows, truth


def obstructions() -> Results:
    """The true channel about two obstacles, one of them low, along a walk around them."""
    block = ((30.0, 30.0), (45.0, 30.0), (45.0, 60.0), (30.0, 60.0))
    hall = ((60.0, 55.0), (90.0, 55.0), (90.0, 90.0), (75.0, 90.0), (75.0, 70.0), (60.0, 70.0))
    obstacles = [
        ObstacleParams(corners_enu_m=block),
        ObstacleParams(corners_enu_m=hall, height_m=8.0),
    ]
    surroundings = Environment(obstacles).around((50.0, 50.0, 0.0))
    edges, corners = surroundings.edges, surroundings.corners[:, :2].copy()
    yield "ways", ways_to(50.0, 50.0, corners, edges, surroundings.ignored)
    rng, memory, shadow = np.random.default_rng(3), NO_MEMORY, shadow_of(ShadowParams())
    for step in range(120):
        angle = 0.11 * step
        e, n, up = 55.0 + 45.0 * math.cos(angle), 55.0 + 40.0 * math.sin(2.3 * angle), 0.2 * step
        drawn = (rng.random(), rng.standard_exponential(), rng.standard_normal())
        open_path = OpenPath(0.5, 8.0, 0.1)
        *added, memory = obstruction(drawn, (e, n, up), open_path, shadow, surroundings, memory)
        yield f"obstruction {step}", added
        yield f"shadow memory {step}", memory
        yield f"detour {step}", detour(e, n, up, surroundings)
        yield f"is blocked {step}", is_blocked(50.0, 50.0, e, n, edges)


def results() -> Results:
    """Everything, by name."""
    yield IS_COMPILED, hasattr(joseph_row, "py_func")
    yield "wrapped", [wrapped(angle) for angle in (-7.0, -math.pi, 0.0, 3.0, math.pi, 12.5)]
    yield from losses()
    yield from obstructions()
    for name, params in LAYOUTS.items():
        yield from updates(name, params)
        yield from windows(name, params)


def save(path: Path) -> None:
    """Write all results into one npz file."""
    arrays = {name: np.asarray(value, dtype=np.float64) for name, value in results()}
    np.savez(path, **arrays)  # type: ignore[arg-type]


if __name__ == "__main__":
    save(Path(sys.argv[1]))
