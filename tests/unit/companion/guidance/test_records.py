"""What the event log says of an estimate: enough to draw and to check it afterwards."""

from companion.domain import EstimateState, RangingMeasurement, TargetEstimate
from companion.estimation.tracker import FusionReport
from companion.guidance.messages import estimate_record

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


def test_the_measurement_and_its_place_are_told() -> None:
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
