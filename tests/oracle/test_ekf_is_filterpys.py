from __future__ import annotations

import math

import msgspec
import pytest

from sim_link.world.environment import ObstacleParams
from tools.study.case import Case
from tools.study.ekf_check import EkfCheck, largest_difference_m
from tools.study.systems import System

SHORT = Case(steps=40)
BLOCK = ObstacleParams(corners_enu_m=((30.0, 30.0), (45.0, 30.0), (45.0, 60.0), (30.0, 60.0)))


@pytest.mark.parametrize(
    "case",
    [
        SHORT,
        msgspec.structs.replace(SHORT, first_estimate="uniform", offsets="prior"),
        msgspec.structs.replace(SHORT, obstacles=(BLOCK,)),
    ],
)
def test_the_ekf_is_filterpys(case: Case) -> None:
    gap_m = largest_difference_m(EkfCheck(case, System("ekf", "latched"), seed=1, runs=2))
    assert 0.0 < gap_m < 1e-9


def test_another_filter_is_not() -> None:
    gap_m = largest_difference_m(EkfCheck(SHORT, System("huber", "latched"), seed=1, runs=1))
    assert 1e-3 < gap_m < math.inf
