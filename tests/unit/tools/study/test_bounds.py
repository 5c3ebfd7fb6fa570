from __future__ import annotations

import msgspec
import numpy as np

from sim_link.world.environment import ObstacleParams, ShadowParams
from tests.unit.tools.study.reporting.case_helpers import canonical_case
from tools.study.case import Case, run_seeds, scene_of
from tools.study.metrics import channel_information, position_bounds_m2
from tools.study.systems import System
from tools.study.trials import bounds_m2, run_block, shaded_steps, shadow_channel

BLOCK = ObstacleParams(corners_enu_m=((30.0, 30.0), (45.0, 30.0), (45.0, 60.0), (30.0, 60.0)))
BEHIND = msgspec.structs.replace(canonical_case(p_nlos=0.1), obstacles=(BLOCK,), steps=60)
PASSIVE = System("asymmetric_huber", "passive")


def test_in_the_open_every_place_tells_the_same_of_its_error() -> None:
    case = Case(steps=60)
    trials = run_block(case, PASSIVE, run_seeds(1, 2))
    information = channel_information(case.channel)
    expected = position_bounds_m2(
        np.ascontiguousarray(trials[0].track_enu_m),
        np.array(case.target_enu_m),
        np.full(60, information.range_per_m2),
        np.full(60, information.bearing_per_rad2),
        np.zeros(2),
    )
    assert np.array_equal(bounds_m2(case, trials)[0], expected)


def test_drawn_offsets_are_known_beforehand_as_well_as_their_priors() -> None:
    fixed = Case(steps=60)
    drawn = msgspec.structs.replace(fixed, offsets="prior")
    of_fixed, of_drawn = (
        bounds_m2(c, run_block(c, PASSIVE, run_seeds(1, 1)))[0] for c in (fixed, drawn)
    )
    assert (of_drawn[10:] < of_fixed[10:]).all()


def test_a_shadow_tells_less() -> None:
    trials = run_block(BEHIND, PASSIVE, run_seeds(1, 1))
    shaded = bounds_m2(BEHIND, trials)[0]
    clear = bounds_m2(msgspec.structs.replace(BEHIND, obstacles=()), trials)[0]
    is_shaded = shaded_steps(
        np.ascontiguousarray(trials[0].track_enu_m), scene_of(BEHIND).surroundings
    )
    assert 0.1 < is_shaded.mean() < 0.9
    assert (shaded[30:] > clear[30:]).all()
    assert shadow_channel(BEHIND).range_bias_mean_m == 15.0


def test_a_shadow_that_tells_of_the_place_has_no_bound_here() -> None:
    case = msgspec.structs.replace(BEHIND, shadow=ShadowParams())
    assert np.isnan(bounds_m2(case, run_block(case, PASSIVE, run_seeds(1, 1)))[0]).all()
