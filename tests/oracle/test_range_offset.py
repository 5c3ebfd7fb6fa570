"""The value to which the filters' range offset settles follows from the loss alone.

On a far and even track the offset is a location estimate of ranges less distances. An M-estimate of
location is where the mean influence of the errors is zero. Source: P. J. Huber, Robust Statistics
(1981), section 3.2.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from companion.estimation.filters.kalman import asymmetric_huber_influence
from tools.study.case import Case
from tools.study.metrics import modified_normal, normal
from tools.study.systems import FilterName, System
from tools.study.trials import RunSeries, tally_of

RUNS = 20


def settled_m(k_short: float) -> float:
    """Return the offset, m, at which the mean influence of the canonical range errors is zero."""
    channel, k_long = Case().channel, 1.5
    errors_m = np.arange(-10.0, 120.0, 0.01)
    clear, blocked = (
        normal(errors_m, channel.range_sigma_m)[0],
        modified_normal(errors_m, channel.range_sigma_m, channel.range_bias_mean_m)[0],
    )
    weights = (1.0 - channel.p_nlos) * clear + channel.p_nlos * blocked

    def mean_influence(shift_m: float) -> float:
        whitened = ((errors_m - shift_m) / channel.range_sigma_m).tolist()
        influences = [asymmetric_huber_influence(u, k_long, k_short) for u in whitened]
        return float(np.dot(influences, weights) / weights.sum())

    return channel.range_offset_m + float(brentq(mean_influence, 0.0, 20.0, xtol=1e-3))


@pytest.mark.parametrize(
    ("name", "k_short", "expected_m"), [("huber", 1.5, 6.45), ("asymmetric_huber", math.inf, 5.23)]
)
def test_neither_offset_settles_at_the_hardwares_alone(
    name: FilterName, k_short: float, expected_m: float
) -> None:
    """The paper says that Huber's offset goes to the hardware's 1.5 m: no equilibrium is there."""
    assert Case().channel.range_offset_m == 1.5
    assert settled_m(k_short) == pytest.approx(expected_m, abs=0.02)
    tally = tally_of(RunSeries(Case(), System(name, "passive"), 1, RUNS))
    assert tally.range_offset_m[-1] / RUNS == pytest.approx(expected_m, abs=0.3)
