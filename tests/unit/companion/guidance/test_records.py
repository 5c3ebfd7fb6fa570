"""Records of an estimate in the event log: enough to draw and to check it afterwards."""

from dataclasses import replace

import pytest

from companion.domain import EstimateState, PositionAccuracy, RangingMeasurement, TargetEstimate
from companion.estimation.tracker import FusionReport
from companion.geometry.coordinates import LocalOrigin
from companion.guidance.messages import estimate_record, radius_texts, result_of

ESTIMATE = TargetEstimate(
    time_s=1.0,
    state=EstimateState.AMBIGUOUS,
    position_enu_m=(1.0, 2.0),
    covariance_m2=((4.0, 1.0), (1.0, 2.0)),
    r95_m=5.0,
    range_offset_m=0.5,
    bearing_offset_rad=0.1,
    measurements=3,
    alternative_enu_m=(9.0, 8.0),
)


def test_the_measurement_and_its_place_are_reported() -> None:
    measured = RangingMeasurement(7, 0.9, range_m=31.0, bearing_enu_rad=0.3)
    report = FusionReport(None, measurement=measured, sensor_enu_m=(10.0, 20.0, 30.0))
    fields = estimate_record(report, ESTIMATE).fields
    assert fields["emitter_id"] == 7
    assert fields["range_m"] == 31.0
    assert fields["bearing_enu_rad"] == 0.3
    assert fields["sensor_enu_m"] == (10.0, 20.0, 30.0)
    assert fields["covariance_m2"] == ESTIMATE.covariance_m2
    assert fields["alternative_enu_m"] == (9.0, 8.0)


def test_without_a_place_nothing_is_claimed_of_one() -> None:
    assert "sensor_enu_m" not in estimate_record(FusionReport(None), ESTIMATE).fields


CITY = PositionAccuracy(6.0, 9.0, is_reported=True)


def test_both_radii_are_reported_and_what_is_between_them() -> None:
    estimate = replace(ESTIMATE, own=CITY, absolute_r95_m=16.0)
    fields = estimate_record(FusionReport(None), estimate).fields
    assert (fields["r95_m"], fields["absolute_r95_m"]) == (5.0, 16.0)
    assert (fields["own_sigma_m"], fields["own_sigma_told"]) == (6.0, True)


def test_degrees_come_with_the_radius_of_who_walks_there() -> None:
    estimate = replace(ESTIMATE, own=CITY, absolute_r95_m=16.0)
    _, text = result_of(estimate, LocalOrigin(47.4, 8.54, 488.0), 0.0)
    assert text.startswith("LOCALISED 47.4000")
    assert text.endswith(" R95 16.0 m")
    assert result_of(estimate, None, 0.0)[1] == "LOCALISED R95 16.0 m"
    assert radius_texts(estimate) == ["R95 16.0 m absolute, 5.0 m relative"]


@pytest.mark.parametrize("sigma_m", [3.0, 12.5, 999.0])
def test_what_is_not_reported_is_said_in_one_text(sigma_m: float) -> None:
    vague = replace(
        ESTIMATE, own=PositionAccuracy(sigma_m, sigma_m), r95_m=999.9, absolute_r95_m=999.9
    )
    radii, own = radius_texts(vague)
    assert own == f"GNSS accuracy not reported: assuming {sigma_m:g} m"
    assert max(len(radii), len(own)) <= 50
