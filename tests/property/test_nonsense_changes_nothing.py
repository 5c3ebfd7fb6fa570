"""A measurement that is refused, whatever it claims, leaves the tracker the same bit for bit."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.screen import RejectReason
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams

POSITION: PositionEnu = (10.0, 5.0, 20.0)
NOW_S = 100.0
GOOD = RangingMeasurement(
    emitter_id=7, measured_at_s=NOW_S, range_m=50.0, range_sigma_m=1.0, bearing_enu_rad=0.4
)
bad_positives = st.one_of(
    st.sampled_from([math.nan, math.inf, -math.inf, 0.0, -0.0, 5e-324, 1e-310, 1e-39]),
    st.floats(max_value=0.0),
    st.integers(1, 2**23 - 1).map(lambda bits: struct.unpack("<f", struct.pack("<I", bits))[0]),
)
"""Not finite, not positive, or denormal in 32 bits."""
bad_bearings = st.one_of(
    st.sampled_from([math.nan, math.inf, -math.inf, 1e-39]),
    st.floats(min_value=3.1416, allow_nan=False),
    st.floats(max_value=-3.1416, allow_nan=False),
)
nonsense = st.one_of(
    bad_positives.map(lambda v: replace(GOOD, range_m=v)),
    bad_positives.map(lambda v: replace(GOOD, range_sigma_m=v)),
    bad_positives.map(lambda v: replace(GOOD, bearing_sigma_rad=v)),
    st.floats(min_value=2000.1).map(lambda v: replace(GOOD, range_m=v)),
    bad_bearings.map(lambda v: replace(GOOD, bearing_enu_rad=v)),
    bad_bearings.map(lambda v: replace(GOOD, bearing_enu_rad=None, bearing_body_rad=v)),
    st.floats(min_value=1.58).map(lambda v: replace(GOOD, elevation_rad=v)),
    st.floats(max_value=NOW_S - 1.01).map(lambda v: replace(GOOD, measured_at_s=v)),
    st.floats(min_value=NOW_S + 0.11).map(lambda v: replace(GOOD, measured_at_s=v)),
    st.integers(0, 65_535).filter(lambda i: i != 7).map(lambda i: replace(GOOD, emitter_id=i)),
)


def _tracker() -> TargetTracker:
    tracker = TargetTracker(TrackerParams())
    for step in range(15):
        seen = replace(GOOD, measured_at_s=NOW_S - 1.0 + 0.05 * step, range_m=50.0 + 0.1 * step)
        tracker.fuse(seen, (2.0 * step, 0.0, 20.0), NOW_S - 0.2)
    return tracker


def _bits(tracker: TargetTracker) -> list[object]:
    """Return all state that a measurement could have changed."""
    return [
        *[
            (h.log_weight, h.state.time_s, h.state.mean.tobytes(), h.state.covariance.tobytes())
            for h in tracker.hypotheses
        ],
        tracker.estimate(NOW_S),
        tracker.health.inflation,
        tracker.integrity.contact,
        tracker.accepted,
        tracker.integrity.restarts,
        tracker.last_accepted_s,
        tracker.emitter_id,
    ]


TRACKER = _tracker()
BEFORE = _bits(TRACKER)


@given(nonsense)
def test_a_measurement_that_means_nothing_has_a_reason_and_no_effect(
    measurement: RangingMeasurement,
) -> None:
    report = TRACKER.fuse(measurement, POSITION, NOW_S)
    assert isinstance(report.reject_reason, RejectReason)
    assert _bits(TRACKER) == BEFORE
