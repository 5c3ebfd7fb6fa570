"""First fixes with and without the prior from a search without contact, in pairs.

Both trackers of a pair get the same measurements of the same flight: lanes over a square in the
worlds of `searched_area`, until the emitter is heard, and on along the lanes. Ranges have normal
errors, and a share of them is too long, as by reflections.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from companion.domain import RangingMeasurement
from companion.estimation.hypotheses import AMBIGUOUS_PROBABILITY, probabilities
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.search.searched_area import SearchedArea, SearchPrior, state_of
from tools.study.searched_area import (
    INTERVAL_S,
    SIDE_M,
    Array,
    are_heard,
    draw_track,
    draw_world,
    search_areas,
)

RANGE_SIGMA_M = 1.5
LONG_SHARE, LONG_M = 0.3, 8.0
"""Share of ranges that are too long, and the mean of their excess (exponential)."""
LONGEST_S = 120.0
"""Time after contact that is evaluated."""
APART_M = 30.0
"""Distance from the emitter beyond which a hypothesis is another position, and a fix too wide."""


@dataclass(frozen=True, slots=True)
class Fix:
    """Times after contact, s; infinite: not within `LONGEST_S`."""

    decided_s: float
    """Time after which no other position has 5 % or more."""
    fix_s: float
    """Time of the first R95 of at most `APART_M` about a position as close to the emitter."""
    right_share: float
    """Share of the time in which the best hypothesis is the right position."""


@dataclass(frozen=True, slots=True)
class FixPair:
    """One flight without and with the prior."""

    flight: int
    without: Fix
    with_prior: Fix


def fly_pair(number: int, seed: int) -> FixPair | None:
    """Fly once; None if the emitter is never heard, or heard before there was a search."""
    rng = np.random.default_rng([seed, number, 2])
    world, model = draw_world(rng)
    grid, track = search_areas(rng), draw_track(rng, SIDE_M)
    cell = int(rng.choice(len(grid.poa), p=grid.poa))
    emitter = grid.centres_enu_m[[cell]] + rng.uniform(-0.5, 0.5, (1, 2)) * grid.cell_m
    heard = np.flatnonzero(are_heard(world, emitter, track, rng)[0])
    if not len(heard) or heard[0] < 20:
        return None
    area = SearchedArea(grid, model)
    for position in track[: heard[0]]:
        area.listen((position[0], position[1], position[2]), INTERVAL_S)
    area.finish()
    measured = [
        (float(index), track[index], _range_m(emitter[0], track[index], rng)) for index in heard
    ]
    prior = SearchPrior.of(state_of(area))
    return FixPair(number, _fix(measured, emitter[0], None), _fix(measured, emitter[0], prior))


def _range_m(emitter: Array, position: Array, rng: np.random.Generator) -> float:
    excess_m = rng.exponential(LONG_M) if rng.random() < LONG_SHARE else 0.0
    slant_m = math.dist((*emitter, 0.0), position)
    return max(1.0, float(slant_m + excess_m + RANGE_SIGMA_M * rng.standard_normal()))


def _fix(
    measured: Sequence[tuple[float, Array, float]], emitter: Array, prior: SearchPrior | None
) -> Fix:
    tracker = TargetTracker(TrackerParams())
    tracker.prior = prior
    began_s = measured[0][0]
    last_open_s, fix_s, right, count = 0.0, math.inf, 0, 0
    for at_s, position, range_m in measured:
        after_s = at_s - began_s
        if after_s > LONGEST_S:
            break
        measurement = RangingMeasurement(1, at_s, range_m=range_m)
        tracker.fuse(measurement, (position[0], position[1], position[2]), at_s)
        estimate = tracker.estimate(at_s)
        if estimate is None:
            continue
        weights = probabilities(tracker.hypotheses)
        away = [math.dist(h.position_enu_m, emitter) > APART_M for h in tracker.hypotheses]
        elsewhere = [w for w, is_away in zip(weights, away, strict=True) if is_away]
        is_open = max(elsewhere, default=0.0) >= AMBIGUOUS_PROBABILITY or sum(elsewhere) > 0.5
        if is_open:
            last_open_s = math.inf
        elif math.isinf(last_open_s):
            last_open_s = after_s
        is_right = math.dist(estimate.position_enu_m, emitter) <= APART_M
        if estimate.r95_m <= APART_M and is_right:
            fix_s = min(fix_s, after_s)
        right += not away[0]
        count += 1
    return Fix(last_open_s, fix_s, right / max(count, 1))


def table_of_pairs(found: Sequence[FixPair | None]) -> tuple[str, bool]:
    """Return the comparison as text; True if no fix is later and other positions vanish sooner."""
    pairs = [pair for pair in found if pair is not None]
    decided, fixed, right = (
        np.array([[getattr(fix, name) for fix in (p.without, p.with_prior)] for p in pairs])
        for name in ("decided_s", "fix_s", "right_share")
    )
    lines = [f"{len(pairs)} flights                 without    with  sooner  later"]
    for name, times in (("other positions gone, s", decided), ("first fix, s", fixed)):
        mean = np.minimum(times, LONGEST_S).mean(axis=0)
        sooner, later = (times[:, 1] < times[:, 0]).sum(), (times[:, 1] > times[:, 0]).sum()
        lines.append(f"{name:24}{mean[0]:10.1f}{mean[1]:8.1f}{sooner:8d}{later:7d}")
    lines.append(f"{'right position best':24}{right[:, 0].mean():10.3f}{right[:, 1].mean():8.3f}")
    is_later = bool((fixed[:, 1] > fixed[:, 0]).any())
    means = np.minimum(decided, LONGEST_S).mean(axis=0)
    return "\n".join(lines) + "\n", not is_later and bool(means[1] <= means[0])
