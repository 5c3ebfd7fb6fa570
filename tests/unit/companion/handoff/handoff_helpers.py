"""A hand-off to format."""

from __future__ import annotations

from companion.domain import DEFAULT_ACCURACY, EstimateState, PositionAccuracy, TargetEstimate
from companion.geometry.coordinates import LocalOrigin
from companion.geometry.polygons import Point
from companion.handoff import Handoff, handoff_of

ORIGIN = LocalOrigin(47.4, 8.54, 488.0)
POSITION_ENU_M = (10.0, 20.0)
HOSTILE = '7<b>&"\x1b[31m\x00'
"""A name that no format may pass on as it is."""


def handoff(
    emitter: str = "7",
    alternative_enu_m: Point | None = None,
    r95_m: float = 5.2,
    own: PositionAccuracy = DEFAULT_ACCURACY,
    height_sigma_m: float | None = None,
) -> Handoff:
    state = EstimateState.LOCALISED if alternative_enu_m is None else EstimateState.AMBIGUOUS
    estimate = TargetEstimate(
        time_s=60.0,
        state=state,
        position_enu_m=POSITION_ENU_M,
        covariance_m2=((4.0, 1.0), (1.0, 2.0)),
        r95_m=r95_m,
        range_offset_m=0.0,
        bearing_offset_rad=0.0,
        measurements=100,
        alternative_enu_m=alternative_enu_m,
        own=own,
        height_sigma_m=height_sigma_m,
    )
    return handoff_of(emitter, estimate, ORIGIN, 1.8e9)
