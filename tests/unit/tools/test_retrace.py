from __future__ import annotations

import numpy as np
import pytest

from tools.benches.filter_bench import SEED
from tools.study.case import Case
from tools.study.step_costs import decided, filter_states, recorded_run, retraced
from tools.study.systems import PlannerName, System
from tools.study.trials import run_trial

SHORT = Case(steps=40)
FILTER_ALONE = System("asymmetric_huber", "passive")


@pytest.mark.parametrize("planner", ["reactive", "latched", "fim", "fim_printed"])
def test_what_is_timed_flies_where_the_run_went(planner: PlannerName) -> None:
    run = recorded_run(SHORT, System("asymmetric_huber", planner))
    track, belief = run.walk.track_enu_m, run.walk.belief
    places = retraced(track, run.walk.z, run.picks, belief, run.steering)
    np.testing.assert_allclose(places[:-1], track[2:], atol=1e-9)
    places = decided(track, run.beliefs, run.picks, belief, run.steering, 2)
    np.testing.assert_allclose(places, track[1:], atol=1e-9)
    assert np.ptp(track, axis=0).max() > SHORT.step_m


def test_the_filter_believes_what_it_did_in_the_run() -> None:
    run = recorded_run(SHORT, FILTER_ALONE)
    beliefs = filter_states(run.walk.track_enu_m, run.walk.z, run.walk.belief)
    trial = run_trial(SHORT, FILTER_ALONE, SEED)
    np.testing.assert_allclose(beliefs.means[:, :2], trial.estimates_enu_m, atol=1e-9)
    np.testing.assert_allclose(beliefs.covariances[:, 0, 1], trial.covariances_m2[:, 1], atol=1e-9)
