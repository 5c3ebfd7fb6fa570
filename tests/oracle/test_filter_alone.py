"""The tracker without window and adaptation is the studies' recursive filter, monitors and all.

Nine ranges in ten are reflected there, so that innovations are always larger than thermal noise.
"""

from __future__ import annotations

import numpy as np
import pytest

from companion.domain import RangingMeasurement
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.estimation.window.window_map import WindowParams
from tools.study.case import Case, channel_draws, measured, run_seeds
from tools.study.systems import PlannerName, System
from tools.study.trials import run_trial

pytestmark = pytest.mark.slow

CASE = Case()
FILTER_ALONE = TrackerParams(
    filter=CASE.belief,
    window=WindowParams(enabled=False),
    adapt_inflation=False,
    range_gross_k=None,
)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("planner", ["latched", "fim"])
def test_no_monitor_touches_the_filter_of_the_studies(planner: PlannerName, seed: int) -> None:
    run = run_seeds(seed, 1)[0]
    trial = run_trial(CASE, System("asymmetric_huber", planner), run)
    draws, tracker = channel_draws(CASE, run), TargetTracker(FILTER_ALONE)
    means = []
    for step, (east_m, north_m) in enumerate(trial.track_enu_m.tolist()):
        range_m, bearing_rad = measured(draws[step], east_m, north_m, trial.truth)
        seen = RangingMeasurement(1, float(step), range_m=range_m, bearing_enu_rad=bearing_rad)
        tracker.fuse(seen, (east_m, north_m, CASE.belief.target_height_m), float(step))
        assert tracker.objection(float(step)) is None
        means.append(tracker.hypotheses[0].state.mean[:2])
    assert tracker.integrity.restarts == 0
    assert not tracker.rejected
    np.testing.assert_allclose(np.array(means), trial.estimates_enu_m, rtol=0, atol=1e-6)
