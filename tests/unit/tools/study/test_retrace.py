from __future__ import annotations

import numpy as np
import pytest

from tools.benches.filter_bench import Walk, retraced
from tools.study.case import Case
from tools.study.systems import PlannerName, System

SHORT = Case(steps=40)


@pytest.mark.parametrize("planner", ["reactive", "latched", "fim", "fim_printed"])
def test_what_is_timed_flies_where_the_run_went(planner: PlannerName) -> None:
    walk = Walk.of(SHORT, System("asymmetric_huber", planner))
    track = walk.track_enu_m
    _, positions = retraced(track, walk.z, walk.picks, walk.belief, walk.steering)
    np.testing.assert_allclose(positions[:-1], track[2:], atol=1e-9)
    assert np.ptp(track, axis=0).max() > SHORT.step_m
