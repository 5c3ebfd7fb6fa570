"""The usable part of a measurement before any estimate is involved."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.screen import (
    AcceptanceParams,
    MeasurementScreen,
    Objection,
    RecentShare,
    RejectReason,
)

TARGET = (60.0, 20.0, 0.0)
ABSURD_RANGE = RangingMeasurement(1, 0.0, range_m=5000.0)
ABSURD_BEARING = RangingMeasurement(1, 0.0, bearing_enu_rad=50.0)


class Radio:
    """Ten measurements a second from a vehicle that flies east at 5 m/s."""

    def __init__(self, range_step_m: float = 0.0) -> None:
        params = FilterParams(range_step_m=range_step_m)
        self.screen = MeasurementScreen(params, AcceptanceParams())
        self.step = 0
        self._rng = np.random.default_rng(1)

    @property
    def now_s(self) -> float:
        return 0.1 * self.step

    @property
    def position(self) -> PositionEnu:
        return (0.5 * self.step, 0.0, 20.0)

    def measure(self) -> RangingMeasurement:
        east, north = TARGET[0] - self.position[0], TARGET[1] - self.position[1]
        return RangingMeasurement(
            1,
            self.now_s,
            range_m=math.dist(self.position, TARGET) + float(self._rng.normal(0.0, 1.5)),
            bearing_enu_rad=math.atan2(north, east) + float(self._rng.normal(0.0, 0.05)),
        )

    def judged(self, seen: RangingMeasurement) -> tuple[bool, bool, RejectReason | None]:
        """Return the usability of range and bearing, and the reason if one is refused."""
        judgement = self.screen.judge(seen, self.position, self.now_s)
        self.step += 1
        passed = judgement.passed
        if passed is None:
            return False, False, judgement.reason
        return passed.range_m is not None, passed.bearing_enu_rad is not None, judgement.reason


def test_what_is_measured_is_used_as_it_is() -> None:
    radio = Radio()
    for _ in range(100):
        seen = radio.measure()
        assert radio.screen.judge(seen, radio.position, radio.now_s).passed is seen
        radio.step += 1
    assert radio.screen.objection is None


@pytest.mark.parametrize("frozen", ["range", "bearing", "both"])
def test_what_is_frozen_is_as_good_as_none(frozen: str) -> None:
    radio = Radio()
    kept = radio.measure()
    for _ in range(30):
        fresh = radio.measure()
        seen = RangingMeasurement(
            1,
            radio.now_s,
            range_m=fresh.range_m if frozen == "bearing" else kept.range_m,
            bearing_enu_rad=fresh.bearing_enu_rad if frozen == "range" else kept.bearing_enu_rad,
        )
        has_range, has_bearing, reason = radio.judged(seen)
    assert (has_range, has_bearing) == (frozen == "bearing", frozen == "range")
    assert reason is RejectReason.FROZEN
    assert radio.screen.objection is None


@pytest.mark.parametrize("step_m", [39.04, 78.07])
def test_steps_that_the_radio_is_known_for_repeat_themselves_until_two_were_flown(
    step_m: float,
) -> None:
    configured, unconfigured = Radio(step_m), Radio()
    for radio in (configured, unconfigured):
        reasons = [
            radio.judged(RangingMeasurement(1, radio.now_s, range_m=1.5 * step_m))[2]
            for _ in range(600)
        ]
        refused_m = 0.5 * next(i for i, reason in enumerate(reasons) if reason is not None)
        assert reasons[-1] is RejectReason.FROZEN
        assert refused_m == pytest.approx(2.0 * step_m if radio is configured else 5.0, abs=0.6)
        assert radio.screen.objection is None


def test_a_frozen_bearing_in_the_body_frame_is_reported_although_the_vehicle_turns() -> None:
    radio = Radio()
    for _ in range(30):
        turned = RangingMeasurement(
            1, radio.now_s, bearing_enu_rad=0.02 * radio.step, bearing_body_rad=0.3
        )
        _, has_bearing, reason = radio.judged(turned)
    assert not has_bearing
    assert reason is RejectReason.FROZEN


def test_a_wrong_unit_of_ranges_leaves_the_bearing_but_speaks_against_flying() -> None:
    radio = Radio()
    for _ in range(30):
        seen = radio.measure()
        assert seen.range_m is not None
        scaled = RangingMeasurement(
            1, radio.now_s, range_m=0.01 * seen.range_m, bearing_enu_rad=seen.bearing_enu_rad
        )
        has_range, has_bearing, reason = radio.judged(scaled)
    assert (has_range, has_bearing, reason) == (False, True, RejectReason.WRONG_UNIT)
    assert radio.screen.objection is Objection.RANGE_UNIT
    radio.screen.clear()
    assert radio.screen.objection is None


@pytest.mark.parametrize(
    ("seen", "reason", "objection"),
    [
        (ABSURD_RANGE, RejectReason.RANGE_ABSURD, Objection.RANGE_UNIT),
        (ABSURD_BEARING, RejectReason.BEARING_ABSURD, Objection.BEARING_UNIT),
        (RangingMeasurement(1, -9.0, range_m=50.0), RejectReason.STALE, None),
    ],
)
def test_mostly_absurd_values_speak_against_flying(
    seen: RangingMeasurement, reason: RejectReason, objection: Objection | None
) -> None:
    radio = Radio()
    for _ in range(30):
        radio.judged(radio.measure())
    for _ in range(12):
        assert radio.screen.admit(seen, radio.position, radio.now_s) is reason
        radio.step += 1
    assert radio.screen.objection is objection
    for _ in range(30):
        radio.judged(radio.measure())
    assert radio.screen.objection is None


def test_degrees_now_and_then_are_refused_but_no_objection() -> None:
    share = RecentShare()
    for step in range(100):
        share.add(0.1 * step, is_true=step % 3 == 0)
        assert not share.is_most
