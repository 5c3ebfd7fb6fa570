"""Compiles the kernels before any work is given out, as far as possible at once.

Every process that runs blocks needs the same kernels; compiled once, they find them in the cache.
The big loop waits for what it calls, so its callees come first, in two processes, and then the
loop in one and the tracker's kernels in another.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec
import numpy as np

from companion.kernel import IS_COMPILED
from companion.planning.crossing_kernels import LATCH_SIZE
from sim_link.evaluation.backends import Backend
from sim_link.evaluation.campaign import Campaign, tally_of
from sim_link.evaluation.case import Case
from sim_link.evaluation.noise import TRUTH, channel_draws, measured_in, scene_of, stream, truth_of
from sim_link.evaluation.systems import (
    System,
    belief_of,
    steering_of,
    track_of,
    window_of_system,
)
from sim_link.evaluation.walk import first_fix, next_place, updated
from sim_link.evaluation.window import solved
from sim_link.world.environment import NO_MEMORY

STEPS = 12
"""Enough of a run to call everything once."""

Stage = Sequence[tuple[str, Case, System]]
"""What may be done at once: the name of a part, and what it is called with."""


def warm_up(flown: Sequence[tuple[Case, System]], backend: Backend) -> None:
    """Call every kernel once that runs of some systems need.

    Args:
        flown: Cases and systems.
        backend: Whose processes share a cache with those that will do the work.
    """
    if not IS_COMPILED or not flown:
        return
    kinds: dict[tuple[bool, bool], tuple[Case, System]] = {}
    for case, system in flown:
        short = msgspec.structs.replace(case, steps=STEPS)
        kinds.setdefault((system.is_compiled, bool(case.obstacles)), (short, system))
    walked = [pair for (is_compiled, _), pair in kinds.items() if is_compiled]
    stages: list[Stage] = []
    if walked:
        stages.append([("filters", *walked[0]), ("window", *walked[0])])
    stages.append([("run", *pair) for pair in kinds.values()])
    for stage in stages:
        for _ in backend.results(_called, stage):
            pass


def _called(part: tuple[str, Case, System]) -> None:
    name, case, system = part
    PARTS[name](case, system)


def _filters(case: Case, system: System) -> None:
    """The updates, by the closed form and by splitting."""
    belief = belief_of(case, system)
    mean, covariance = first_fix(0.0, 0.0, 20.0, 0.0, belief)
    for iterations in (0, 1):
        updated(mean, covariance, np.zeros(3), _views(1)[0], belief._replace(iterations=iterations))


def _window(case: Case, system: System) -> None:
    """The window, the planners and the channel."""
    belief, steering = belief_of(case, system), steering_of(case, system)
    mean, covariance = first_fix(0.0, 0.0, 20.0, 0.0, belief)
    rows = np.column_stack([track_of(case), _views(STEPS)[:, :2]])
    solved(rows, mean, 1, window_of_system(case, system))
    sensor, latch = np.zeros(3), np.zeros(LATCH_SIZE)
    next_place(sensor, mean, covariance, 0.0, latch, belief, steering)
    truth, draws = truth_of(case, stream(0, TRUTH)), channel_draws(case, 0)
    measured_in(draws[0], 0.0, 0.0, truth, scene_of(case), NO_MEMORY)


def _run(case: Case, system: System) -> None:
    """A whole block of one short run, with all that is told of it."""
    tally_of(Campaign(case, system, 0, 1).blocks()[0])


def _views(count: int) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Ranges and bearings of nothing in particular, (count, 3)."""
    views = np.full((count, 3), np.nan)
    views[:, 0], views[:, 1] = 20.0, np.linspace(0.0, 1.0, count)
    return views


PARTS: dict[str, Callable[[Case, System], None]] = {
    "filters": _filters,
    "window": _window,
    "run": _run,
}
