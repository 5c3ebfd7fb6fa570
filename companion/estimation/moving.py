"""What becomes of an estimate when the vehicle's own navigation jumps: it moves along.

All that was measured is relative to the vehicle, so the target, and every place that it was seen
from, move by as much as the reported position; bearings that are measured from the heading turn
against it, and so does their offset. A known height of the target stays: it does not depend on
where the vehicle believes to be.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from companion.domain import PositionEnu
from companion.estimation.base import FilterState
from companion.estimation.filter_params import FilterParams
from companion.estimation.hypotheses import Hypothesis
from companion.estimation.map_kernels import VALUES
from companion.geometry.arrays import Matrix, Vector
from companion.geometry.frames import wrap_pi
from companion.models.ranging_model import BEARING, BEARING_OFFSET, EAST, NORTH

JUMP_SIGMA_M = 0.2
JUMP_SIGMA_RAD = math.radians(2.0)
"""How well a jump is known."""


def state_step(params: FilterParams, shift_enu_m: PositionEnu, turn_rad: float) -> Vector:
    """By how much each component of a state moves, (n,).

    Args:
        params: Layout of the state.
        shift_enu_m: By how much the vehicle's reported position jumped.
        turn_rad: By how much bearings turned, counter-clockwise.
    """
    step = np.zeros(len(params.prior[0]))
    step[EAST], step[NORTH], step[BEARING_OFFSET] = *shift_enu_m[:2], turn_rad
    height = params.model.height_index
    if height >= 0:
        step[height] = shift_enu_m[2]
    return step


def moved(hypothesis: Hypothesis, step: Vector) -> Hypothesis:
    """The hypothesis after a jump.

    Args:
        hypothesis: Before it.
        step: (n,), see `state_step`.
    """
    state = hypothesis.state
    mean = state.mean + step
    mean[BEARING_OFFSET] = wrap_pi(float(mean[BEARING_OFFSET]))
    doubt = np.where(step == 0.0, 0.0, JUMP_SIGMA_M**2)
    if step[BEARING_OFFSET] != 0.0:
        doubt[BEARING_OFFSET] = JUMP_SIGMA_RAD**2
    covariance = state.covariance + np.diag(doubt)
    return replace(hypothesis, state=FilterState.of(state.time_s, mean, covariance))


def moved_rows(
    rows: Matrix, shift_enu_m: PositionEnu, step: Vector, params: FilterParams
) -> Matrix:
    """Measurements as they would have been made after a jump, (n, 10).

    Args:
        rows: (n, 10), see `map_kernels`.
        shift_enu_m: By how much the vehicle's reported position jumped.
        step: (n,), see `state_step`.
        params: Layout of the state.
    """
    east_m, north_m, up_m = shift_enu_m
    after = np.array(rows)
    after[:, 0] += east_m
    after[:, 1] += north_m
    if params.model.height_index >= 0:
        after[:, 2] += up_m
    after[:, VALUES + BEARING] += step[BEARING_OFFSET]
    return after
