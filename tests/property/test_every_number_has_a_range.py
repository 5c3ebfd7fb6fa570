"""Any number that a radio reports or a file configures is refused in words, or computed with."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from companion.config.schema import CompanionConfig, inconsistency
from companion.domain import ArrayDirection, PositionEnu, RangingMeasurement
from companion.errors import ConfigError
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.geometry.coordinates import wrap_pi
from companion.mav.dialect import MAVLink_radio_ranging_message
from tests.unit.companion.link.wire import OFFBOARD, Wire

EVERY_DAY = (math.nan, math.inf, -math.inf, 0.0, -1.0, 1e-300, 1e-6, 90.0, 1e6, 3e38)
"""One of each size."""
BETWEEN = (1e-38, 1e-12, 1e-3, 2000.0, 1e9, 1e30, 1e300)
EXTREMES = (*EVERY_DAY, *BETWEEN)
SIZES = [EVERY_DAY, pytest.param(BETWEEN, marks=pytest.mark.slow)]
SLOW = pytest.mark.slow
TARGET = (30.0, 40.0, 0.0)
COUNT = 50
"""Measurements of a flight: past the check of the antenna, which needs 40 bearings."""
AXES = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0))


def flown(
    rng: np.random.Generator, *, is_array: bool
) -> Iterator[tuple[RangingMeasurement, PositionEnu]]:
    """Yield honest measurements about the target, of an azimuth or of a level planar array."""
    for step in range(COUNT):
        angle_rad = 0.15 * step
        position = (TARGET[0] + 30.0 * math.cos(angle_rad), 20.0 + step * 0.5, 20.0)
        away = np.subtract(TARGET, position)
        bearing_rad = math.atan2(away[1], away[0]) + float(rng.normal(0.0, 0.03))
        array = ArrayDirection(*AXES, wrap_pi(-bearing_rad)) if is_array else None
        yield (
            RangingMeasurement(
                emitter_id=1,
                measured_at_s=0.2 * step,
                range_m=float(np.linalg.norm(away) + rng.normal(0.0, 1.5)),
                range_sigma_m=1.5,
                bearing_enu_rad=None if is_array else wrap_pi(bearing_rad),
                bearing_body_rad=wrap_pi(-bearing_rad) if is_array else None,
                bearing_sigma_rad=0.035,
                array=array,
            ),
            position,
        )


def check(tracker: TargetTracker, now_s: float) -> None:
    """Assert that every number of the estimate is one."""
    for hypothesis in tracker.hypotheses:
        assert np.isfinite(hypothesis.state.mean).all()
        assert np.isfinite(hypothesis.state.covariance).all()
    estimate = tracker.estimate(now_s)
    assert estimate is None or math.isfinite(estimate.r95_m)


FIELDS = (
    *("range_m", "range_sigma_m", "elevation_rad", "elevation_sigma_rad", "quality"),
    *("bearing_enu_rad", "bearing_sigma_rad"),
)


@pytest.mark.parametrize("extremes", SIZES, ids=["every day", "between"])
@pytest.mark.parametrize(
    ("field", "is_array"),
    [
        *((field, False) for field in FIELDS),
        *(pytest.param(f, True, marks=[] if "bearing" in f else SLOW) for f in FIELDS),
    ],
)
@pytest.mark.filterwarnings("error")
def test_an_extreme_of_any_reported_number_is_refused_or_computed_with(
    field: str, is_array: bool, extremes: tuple[float, ...]
) -> None:
    for extreme in extremes:
        rng = np.random.default_rng(5)
        tracker = TargetTracker(TrackerParams())
        for number, (seen, position) in enumerate(flown(rng, is_array=is_array)):
            said = replace(seen, **{field: extreme}) if number % 2 else seen  # type: ignore[arg-type]
            tracker.fuse(said, position, seen.measured_at_s)
            check(tracker, seen.measured_at_s)
        assert tracker.accepted >= COUNT // 2


def test_an_extreme_of_any_field_of_a_ranging_message_is_survived() -> None:
    wire = Wire().ready(OFFBOARD)
    usual = [40.0, 1.5, 0.5, 0.03, -0.3, 0.05]
    for index in range(len(usual)):
        for extreme in EXTREMES:
            values = list(usual)
            values[index] = math.copysign(math.inf, extreme) if abs(extreme) > 3.4e38 else extreme
            wire.now_s += 0.05
            stamp_us = round(1e6 * wire.now_s)
            range_m, range_std, bearing, bearing_std, up, up_std = values
            message = MAVLink_radio_ranging_message(
                stamp_us, range_m, range_std, bearing, bearing_std, up, up_std, 1, 255, 0
            )
            wire.say(wire.position())
            wire.say(message)
            wire.wait(0.05)
            check(wire.endpoint.session.tracker, wire.now_s)


def numbers_of(value: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Yield the paths of all numbers of a configuration that is plain values."""
    if isinstance(value, dict):
        for key, child in value.items():
            yield from numbers_of(child, (*path, key))
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield path


PLAIN = msgspec.to_builtins(CompanionConfig())
PATHS = [
    *numbers_of(PLAIN),
    *(
        ("estimation", "filter", key)
        for key in (
            "range_offset_min_m",
            "range_offset_max_m",
            "range_k_short",
            "reach_m",
            "stamp_lag_sigma_s",
        )
    ),
]


def configured(path: tuple[str, ...], value: float) -> CompanionConfig | None:
    """Return the defaults with one other number; None: that is refused."""
    raw = msgspec.to_builtins(CompanionConfig())
    owner = raw
    for key in path[:-1]:
        owner = owner[key]
    owner[path[-1]] = int(value) if type(owner[path[-1]]) is int and abs(value) < 1e19 else value
    try:
        config = msgspec.convert(raw, CompanionConfig, strict=True)
        return None if inconsistency(config) else config
    except (msgspec.ValidationError, ConfigError):
        return None


@pytest.mark.parametrize("extremes", SIZES, ids=["every day", "between"])
@pytest.mark.parametrize("path", PATHS, ids=".".join)
def test_an_extreme_of_any_configured_number_is_refused_or_flown_with(
    path: tuple[str, ...], extremes: tuple[float, ...]
) -> None:
    finite = [v for v in extremes if math.isfinite(v)]  # a file has no others
    assert configured(path, 1e30) is None
    for extreme in finite:
        if abs(extreme) > 0.0 and abs(extreme) < 1e-12:
            continue  # refused by the reader of files
        config = configured(path, extreme)
        if config is None:
            continue
        if path[0] == "estimation":
            tracker = TargetTracker(config.tracking)
            for seen, position in flown(np.random.default_rng(5), is_array=False):
                tracker.fuse(seen, position, seen.measured_at_s)
            check(tracker, COUNT * 0.2)
        else:
            wire = Wire(config).ready(OFFBOARD)
            wire.say(
                MAVLink_radio_ranging_message(0, 40.0, 1.5, 0.5, 0.03, *2 * (math.nan,), 1, 255, 0)
            )
            wire.wait(0.5)
