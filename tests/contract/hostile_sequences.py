"""Measurements as no sane radio sends them, through filters of random settings.

A filter guarantees that its covariance stays symmetric positive definite and never grows on an
update, whatever its input; where rounding makes that impossible it reports so and keeps its state.
One sequence draws a filter's parameters, a first state, and some steps with huge and tiny waits,
zero range, repeated geometry, late measurements and extreme sigmas; `fault_of` judges every update.
A sequence depends on its seed alone, so a failure can be repeated by itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.filters.target_filter import (
    FilterParams,
    FilterState,
    Inflation,
    TargetFilter,
    UpdateReport,
)
from companion.kernel import Matrix

MakeFilter = Callable[[FilterParams], TargetFilter]

STEPS = 8
WAITS_S = (0.0, 1e-12, 1e-3, 1.0, 60.0, 1e6, 1e9)
SIGMAS = (1e-300, 1e-45, 1e-12, 1e-6, 1e-3, 1.0, 1e3, 1e6, 1e12, 3e38, 1e300)
"""Down to and up to what 32 bits hold, as on the wire, and 64 bits, as in a file."""
RANGES_M = (0.0, 1e-9, 1e-3, 1.0, 2000.0)
SPREADS_M = (1e-3, 1.0, 30.0, 1e4)
ROUNDING = 1e-12
"""Growth of a variance that is rounding, as a share of the covariance's trace."""


@dataclass(frozen=True, slots=True)
class SequenceOutcome:
    """Result of one sequence, or of many."""

    sequences: int = 0
    updates: int = 0
    refused: int = 0
    """Updates that the filter itself declared lost."""
    faults: tuple[str, ...] = ()
    """Broken promises, each with the sequence that broke it."""

    def joined(self, other: SequenceOutcome) -> SequenceOutcome:
        """Return both results together."""
        return SequenceOutcome(
            self.sequences + other.sequences,
            self.updates + other.updates,
            self.refused + other.refused,
            self.faults + other.faults,
        )


@dataclass(frozen=True, slots=True)
class HostileStep:
    """One measurement with all other inputs of a filter."""

    wait_s: float
    measurement: RangingMeasurement
    sensor_enu_m: PositionEnu
    inflation: Inflation


def hostile_params(rng: np.random.Generator) -> FilterParams:
    """Draw any filter: plane or space, with or without scale, thresholds, bounds, random walk."""

    def either(*values: float | None) -> float | None:
        """Return one of some values, perhaps none."""
        return values[int(rng.integers(len(values)))]

    def one_of(*values: float) -> float:
        """Return one of some values."""
        return values[int(rng.integers(len(values)))]

    return FilterParams(
        range_k_long=either(None, 1e-3, 1.5, 1e6),
        range_k_short=either(None, None, 1e-3, 3.0),
        bearing_k=either(None, 1e-3, 1.5),
        range_offset_sigma_m=one_of(1e-3, 5.0, 1e3),
        range_offset_min_m=either(None, 0.0, -1.0),
        range_offset_max_m=either(None, 1e-3, 3.0),
        bearing_offset_sigma_deg=one_of(0.01, 5.0, 500.0),
        bearing_offset_max_deg=one_of(1e-3, 15.0, 180.0),
        range_scale_sigma=one_of(0.0, 0.0, 0.05, 0.5),
        range_scale_max=one_of(1e-6, 0.2, 0.5),
        own_position_sigma_m=one_of(0.0, 0.1, 10.0),
        process_noise_m_per_sqrt_s=one_of(0.0, 0.5, 100.0),
        target_height_m=one_of(0.0, -1e3, 10.0),
        target_height_sigma_m=one_of(0.0, 0.0, 1e-3, 5.0, 1e4),
        near_target_terms=bool(rng.random() < 0.8),
    )


def hostile_state(params: FilterParams, rng: np.random.Generator) -> FilterState:
    """Draw a state as a filter of these params may have it, its components correlated at random."""
    mean, sigmas = params.prior
    mean[:2] = rng.uniform(-100.0, 100.0, 2)
    sigmas[:2] = rng.choice(SPREADS_M, 2)
    root = np.eye(mean.size) + rng.uniform(0.0, 1.0) * rng.normal(size=(mean.size, mean.size))
    scale = sigmas / np.linalg.norm(root, axis=1)
    covariance = (root @ root.T) * np.outer(scale, scale)
    symmetric = 0.5 * (covariance + covariance.T)
    return FilterState.of(0.0, np.clip(mean, *params.bounds), symmetric)


def hostile_steps(
    params: FilterParams, rng: np.random.Generator, steps: int = STEPS
) -> Iterator[Callable[[FilterState], HostileStep]]:
    """Yield steps that depend on the state: the worst vantage point is the estimate itself."""
    repeats = rng.random() < 0.3
    once: HostileStep | None = None
    for _ in range(steps):

        def step(state: FilterState) -> HostileStep:
            """Return the next step, or the first one again."""
            nonlocal once
            if once is None or not repeats:
                once = _step(state, params, rng)
            return once

        yield step


def _step(state: FilterState, params: FilterParams, rng: np.random.Generator) -> HostileStep:
    wait_s = float(rng.choice(WAITS_S))
    late_s = float(rng.choice([0.0, 0.0, 0.5, 1.0, 1e6]))
    position = (*rng.uniform(-100.0, 100.0, 2).tolist(), float(rng.uniform(0.0, 60.0)))
    if rng.random() < 0.3:  # on the estimate or right above it
        height_index = params.model.height_index
        up = state.mean[height_index] if height_index >= 0 else params.target_height_m
        rise_m = float(rng.choice([0.0, 1e-6, 1e-3, 20.0]))
        aside_m = float(rng.choice([0.0, 1e-9, 1e-3, 0.05]))
        position = (float(state.mean[0]) + aside_m, float(state.mean[1]), float(up) + rise_m)
    inflation = rng.choice([1.0, 1.0, 4.0, 400.0], 3).tolist()
    measurement = hostile_measurement(state.time_s + wait_s - late_s, rng)
    return HostileStep(wait_s, measurement, position, (inflation[0], inflation[1], inflation[2]))


def hostile_measurement(measured_at_s: float, rng: np.random.Generator) -> RangingMeasurement:
    """Draw any range, any direction, any positive sigma; at least one of them."""
    has = int(rng.integers(1, 8))
    extreme = rng.random(3) < 0.3
    sigmas = [float(rng.choice(SIGMAS)) if is_extreme else None for is_extreme in extreme]
    ranges_m = [*RANGES_M, float(rng.uniform(0.1, 200.0))]
    return RangingMeasurement(
        emitter_id=1,
        measured_at_s=measured_at_s,
        range_m=float(rng.choice(ranges_m)) if has & 1 else None,
        range_sigma_m=sigmas[0],
        bearing_enu_rad=float(rng.uniform(-2.0 * math.pi, 2.0 * math.pi)) if has & 2 else None,
        bearing_sigma_rad=sigmas[1],
        elevation_rad=float(rng.uniform(-0.5 * math.pi, 0.5 * math.pi)) if has & 4 else None,
        elevation_sigma_rad=sigmas[2],
    )


def run_sequence(
    target_filter: TargetFilter, params: FilterParams, rng: np.random.Generator, steps: int = STEPS
) -> SequenceOutcome:
    """Run one hostile sequence through a filter of these params; it ends with the first fault."""
    state = hostile_state(params, rng)
    updates = refused = 0
    for step_at in hostile_steps(params, rng, steps):
        step = step_at(state)
        prior = target_filter.predict(state, state.time_s + step.wait_s)
        report = target_filter.update(prior, step.measurement, step.sensor_enu_m, step.inflation)
        updates += 1
        refused += not report.is_positive_definite
        fault = fault_of(report, prior, params.bounds)
        if fault is not None:
            return SequenceOutcome(1, updates, refused, (f"{fault} after {step}",))
        state = report.state
    return SequenceOutcome(1, updates, refused)


def fault_of(report: UpdateReport, prior: FilterState, bounds: Matrix) -> str | None:
    """Return the guarantee that an update broke, or None.

    Args:
        prior: The state before the update.
        bounds: (2, n) of the state.
    """
    after = report.state
    if not report.is_positive_definite:
        return None if after is prior else "declared lost, but the state changed"
    mean, covariance = after.mean, after.covariance
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
        return "not finite"
    if not np.array_equal(covariance, covariance.T):
        return "not symmetric"
    if least_correlation_eigenvalue(covariance) <= 0.0:
        return "not positive definite"
    growth = np.diag(covariance - prior.covariance)
    if float(growth.max()) > ROUNDING * float(np.trace(prior.covariance)):
        return f"grew by {growth.max():g}"
    if (mean < bounds[0]).any() or (mean > bounds[1]).any() or abs(mean[3]) > math.pi:
        return "out of bounds"
    if not all(row is None or 0.0 < row.weight <= 1.0 for row in report.modalities):
        return "weight not in (0, 1]"
    return None


def least_correlation_eigenvalue(covariance: Matrix) -> float:
    """Return the smallest eigenvalue once scaled to ones on the diagonal, independent of units."""
    variances = np.diag(covariance)
    if not (variances > 0.0).all():
        return -math.inf
    scale = 1.0 / np.sqrt(variances)
    return float(np.linalg.eigvalsh(covariance * np.outer(scale, scale))[0])


def run_campaign(make: dict[str, MakeFilter], first: int, count: int, seed: int) -> SequenceOutcome:
    """Run sequences `first` to `first + count`, the filters alternating.

    Args:
        first: Number of the first sequence; with the seed it determines its contents.
    """
    total = SequenceOutcome()
    names = sorted(make)
    for number in range(first, first + count):
        rng = np.random.default_rng([seed, number])
        name = names[number % len(names)]
        params = hostile_params(rng)
        outcome = run_sequence(make[name](params), params, rng)
        faults = tuple(f"{name}, sequence {number}: {fault}" for fault in outcome.faults)
        total = total.joined(SequenceOutcome(1, outcome.updates, outcome.refused, faults))
    return total
