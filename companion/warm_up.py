"""Invented first flights, in which every kernel is called as flights call it.

The kernels are compiled for the types that these calls have, ahead of a flight by
`companion.kernel_builder`, or at their first call where numba compiles within the process. That
takes half a minute, and would starve the control tick of a flight.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np

from companion.domain import ArrayDirection, RangingMeasurement
from companion.estimation.antenna import LEVEL
from companion.estimation.measurement_model import AZIMUTH, COSINES
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.planning.planner import Planner, PlanRequest

TARGET_M = (12.0, 9.0)
RADIUS_M = 20.0
FAR_M = 500.0
"""Target distance at which an array approaches from the side, beyond any overshoot."""
HEIGHT_M = 15.0
SMALL_WINDOW = 32
"""Measurements; the least that a configuration may have, so it is full and thinned out soonest.
Twice as many are fused."""


def warm_up(params: TrackerParams, planner: Planner[Any]) -> None:
    """Fly in circles about an invented emitter until every kernel has been called.

    The kernels in use depend on the measured quantities, and on a full window.
    """
    window = msgspec.structs.replace(params.window, size=SMALL_WINDOW)
    params = msgspec.structs.replace(params, window=window)
    rng = np.random.default_rng(0)
    memory: Any = None
    for has_range, has_bearing in ((True, True), (True, False), (False, True)):
        tracker = TargetTracker(params)
        for step in range(2 * SMALL_WINDOW):
            time_s, angle = 0.1 * step, 0.1 * step
            sensor_enu_m = (RADIUS_M * math.cos(angle), RADIUS_M * math.sin(angle), HEIGHT_M)
            seen = _seen(sensor_enu_m, time_s, rng, has_range, has_bearing)
            if has_bearing:
                seen = _by_array(seen, sensor_enu_m, params.filter.model.antenna)
            tracker.fuse(seen, sensor_enu_m, time_s)
        request = PlanRequest(
            (RADIUS_M, 0.0),
            tracker.estimate(60.0),
            baseline_m=tracker.baseline_m(HEIGHT_M),
            time_s=60.0,
            contact_s=60.0,
            height_m=HEIGHT_M,
            altitude_offset_m=0.0,
            yaw_enu_rad=0.0,
            sigmas=tracker.latest_sigmas,
            joint_covariance=tracker.joint_covariance((0.0, 0.0, HEIGHT_M)),
        )
        memory = planner.plan(request, memory).memory
        planner.plan(replace(request, vehicle_enu_m=(FAR_M, 0.0)), None)


def _seen(
    sensor_enu_m: tuple[float, float, float],
    time_s: float,
    rng: np.random.Generator,
    has_range: bool,
    has_bearing: bool,
) -> RangingMeasurement:
    east, north = TARGET_M[0] - sensor_enu_m[0], TARGET_M[1] - sensor_enu_m[1]
    range_m = math.hypot(east, north, sensor_enu_m[2]) + float(rng.normal())
    bearing_rad = math.remainder(math.atan2(north, east) + 0.03 * float(rng.normal()), math.tau)
    return RangingMeasurement(
        emitter_id=1,
        measured_at_s=time_s,
        range_m=range_m if has_range else None,
        bearing_enu_rad=bearing_rad if has_bearing else None,
    )


def _by_array(
    seen: RangingMeasurement, sensor_enu_m: tuple[float, float, float], antenna: int
) -> RangingMeasurement:
    """Return the measurement with its direction by a level antenna array, if the antenna is one."""
    ahead, right, down = LEVEL
    bearing_rad = seen.bearing_enu_rad
    if antenna == COSINES:
        slant_m = math.dist((*TARGET_M, 0.0), sensor_enu_m)
        south, below = (sensor_enu_m[1] - TARGET_M[1]) / slant_m, sensor_enu_m[2] / slant_m
        return replace(seen, array=ArrayDirection(right, down, south, below))
    if antenna == AZIMUTH or bearing_rad is None:
        return seen
    return replace(seen, array=ArrayDirection(ahead, right, -bearing_rad))
