"""The Cramer-Rao bound of a case on the tracks that were flown in it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from companion.kernel import Matrix, Vector, kernel
from sim_link.evaluation.case import Case
from sim_link.evaluation.cramer_rao import (
    ChannelInformation,
    channel_information,
    position_bounds_m2,
)
from sim_link.evaluation.noise import scene_of
from sim_link.evaluation.trial import TrialResult
from sim_link.world.environment import ChannelParams, ShadowParams
from sim_link.world.line_of_sight import Surroundings, is_blocked_in_space


def bounds_m2(case: Case, trials: Sequence[TrialResult]) -> list[Vector]:
    """The bound on the squared error after every step of every run, (steps,) each, m^2.

    Behind obstacles it is known for shadows whose draws are new at every place. Detours, pulls and
    correlated draws tell of the place by themselves, so that no bound is given for them (NaN).
    """
    if case.obstacles and not is_memoryless(case.shadow):
        return [np.full(len(trial.record), math.nan) for trial in trials]
    clear = channel_information(case.channel, is_joint=case.nlos_draws == "joint")
    shaded = channel_information(shadow_channel(case)) if case.obstacles else clear
    target, surroundings = np.array(case.target_enu_m), scene_of(case).surroundings
    prior = np.zeros(2)
    if case.offsets == "prior":
        prior = 1.0 / case.belief.prior[1][2:4] ** 2
    bounds = []
    for trial in trials:
        track = np.ascontiguousarray(trial.track_enu_m)
        information = track_information(track, clear, shaded, surroundings)
        bounds.append(position_bounds_m2(track, target, *information, prior))
    return bounds


def track_information(
    track_enu_m: Matrix,
    clear: ChannelInformation,
    shaded: ChannelInformation,
    surroundings: Surroundings,
) -> tuple[Vector, Vector]:
    """Information of the range, 1/m^2, and the bearing, 1/rad^2, at every place, (steps,) each."""
    is_shaded = shaded_places(track_enu_m, surroundings)
    return (
        np.where(is_shaded, shaded.range_per_m2, clear.range_per_m2),
        np.where(is_shaded, shaded.bearing_per_rad2, clear.bearing_per_rad2),
    )


@kernel
def shaded_places(track_enu_m: Matrix, surroundings: Surroundings) -> Vector:
    """1 where an obstacle blocks the path to the target, otherwise 0, (steps,)."""
    is_shaded = np.zeros(track_enu_m.shape[0])
    for step in range(track_enu_m.shape[0]):
        if is_blocked_in_space(
            surroundings.east_m,
            surroundings.north_m,
            surroundings.up_m,
            track_enu_m[step, 0],
            track_enu_m[step, 1],
            0.0,
            surroundings.edges,
        ):
            is_shaded[step] = 1.0
    return is_shaded


def is_memoryless(shadow: ShadowParams) -> bool:
    """Whether draws in a shadow say nothing of the place they were made at."""
    return shadow.detour_share == shadow.pull_share == shadow.correlation_m == 0.0


def shadow_channel(case: Case) -> ChannelParams:
    """What a path suffers behind an obstacle, as a channel of its own."""
    return msgspec.structs.replace(
        case.channel,
        p_nlos=1.0,
        range_bias_mean_m=case.shadow.extra_bias_mean_m,
        bearing_bias_sigma_deg=case.shadow.bearing_bias_sigma_deg,
    )
