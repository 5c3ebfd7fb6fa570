"""Messages about health and targets to events; an unknown value is not a number."""

from __future__ import annotations

import math

import pytest

from companion.domain import MAX_COORDINATE_M, BatteryLevel
from companion.guidance.events import (
    AccuracySource,
    BatteryReported,
    EstimatorStatusReported,
    Event,
    FixReported,
    PositionAccuracyReported,
    RcStatusReported,
    SetpointEchoed,
    SticksReported,
)
from companion.link.inbound import VehicleInbound
from companion.mav.dialect import MAVLink_ekf_status_report_message, Message, mavlink

NAN, INF = math.nan, math.inf
UINT16_MAX, UINT32_MAX = 2**16 - 1, 2**32 - 1


def events(message: Message) -> list[Event]:
    return VehicleInbound().events(message, 5.0)


def health_of(message: Message) -> list[Event]:
    """Return the events of a message without the accuracy of the own position."""
    return [event for event in events(message) if not isinstance(event, PositionAccuracyReported)]


def rating_of(message: Message) -> PositionAccuracyReported:
    """Return the accuracy of the own position."""
    (rating,) = (event for event in events(message) if isinstance(event, PositionAccuracyReported))
    return rating


def gps(fix_type: int = 3, h_acc: int = 0, v_acc: int = 0) -> Message:
    fields = (0, fix_type, 0, 0, 0, 0, 0, 0, 0, 255, 0, h_acc, v_acc)
    return mavlink.MAVLink_gps_raw_int_message(*fields)


def target(north: float, east: float, down: float, mask: int = 0, frame: int = 1) -> Message:
    return mavlink.MAVLink_position_target_local_ned_message(
        0, frame, mask, north, east, down, *(0.0,) * 6, 0.0, 0.0
    )


def estimator_status(velocity: float, position: float, height: float, mag: float) -> Message:
    """Terrain and airspeed, which few vehicles have, are bad."""
    return mavlink.MAVLink_estimator_status_message(
        0, 0, velocity, position, height, mag, 9.0, 9.0, 0.3, 0.4
    )


def battery_status(percent: int, charge_state: int = 0, number: int = 0) -> Message:
    return mavlink.MAVLink_battery_status_message(
        number, 0, 0, 0, [UINT16_MAX] * 10, -1, -1, -1, percent, charge_state=charge_state
    )


def sys_status(percent: int) -> Message:
    return mavlink.MAVLink_sys_status_message(0, 0, 0, 0, 0, -1, percent, *(0,) * 6)


def rc_channels(roll: int, pitch: int, throttle: int, yaw: int, count: int = 4) -> Message:
    unused = (UINT16_MAX,) * 14
    return mavlink.MAVLink_rc_channels_message(0, count, roll, pitch, throttle, yaw, *unused, 255)


def test_a_target_is_a_place() -> None:
    assert events(target(1.0, 2.0, -3.0)) == [SetpointEchoed(5.0, (2.0, 1.0, 3.0))]


@pytest.mark.parametrize("message", [target(NAN, 2.0, -3.0), target(1.0, 2.0, -3.0, mask=0x7)])
def test_a_target_without_a_position_is_one_all_the_same(message: Message) -> None:
    assert events(message) == [SetpointEchoed(5.0, None)]


def test_a_target_outside_the_local_frame_is_none() -> None:
    assert events(target(1.1 * MAX_COORDINATE_M, 2.0, -3.0)) == []


def test_a_target_in_another_frame_cannot_be_compared() -> None:
    assert events(target(1.0, 2.0, -3.0, frame=8)) == []


@pytest.mark.parametrize(
    ("ratios", "worst"),
    [
        ((0.1, 0.2, 0.3, 0.4), 0.2),
        ((0.1, 1.5, 0.3, 0.4), 1.5),
        ((1.2, 0.2, 0.3, 0.4), 1.2),
        ((0.1, 0.2, 9.0, 9.0), 0.2),
        ((NAN, 0.2, INF, 0.1), 0.2),
    ],
)
def test_px4_judges_by_velocity_and_horizontal_position(
    ratios: tuple[float, float, float, float], worst: float
) -> None:
    (event,) = health_of(estimator_status(*ratios))
    assert isinstance(event, EstimatorStatusReported)
    assert event.worst == pytest.approx(worst)


@pytest.mark.parametrize(
    ("velocity", "position", "height", "compass", "is_poor"),
    [
        (0.1, 0.8, 0.2, 0.3, False),
        (0.1, 9.0, 9.0, 0.3, False),
        (0.1, 0.1, 0.1, 9.0, False),
        (0.8, 0.8, 0.2, 0.3, True),
        (0.1, 0.8, 0.2, 0.8, True),
        (1.5, 0.1, 0.2, 0.3, False),
        (1.6, 0.1, 0.2, 0.3, True),
        (NAN, 0.9, NAN, 0.9, True),
    ],
)
def test_ardupilot_counts_two_votes_of_three_or_twice_the_velocity(
    velocity: float, position: float, height: float, compass: float, is_poor: bool
) -> None:
    report = MAVLink_ekf_status_report_message(0, velocity, position, height, compass, 9.0)
    (event,) = events(report)
    assert isinstance(event, EstimatorStatusReported)
    assert (event.worst >= 1.0) is is_poor


@pytest.mark.parametrize(
    ("flags", "has_position"),
    [(0, None), (1 + 16, True), (1 + 8, True), (1 + 32, False), (128 + 16, False)],
)
def test_flags_say_if_there_is_a_position(flags: int, has_position: bool | None) -> None:
    (event,) = events(MAVLink_ekf_status_report_message(flags, 0.1, 0.1, 0.1, 0.1, 0.0))
    assert isinstance(event, EstimatorStatusReported)
    assert event.has_position is has_position


def test_no_flags_are_no_position_once_there_were_some() -> None:
    """ArduPilot reports zeros while no EKF runs (AP_AHRS, send_ekf_status_report)."""
    inbound = VehicleInbound()
    verdicts = [
        inbound.events(MAVLink_ekf_status_report_message(flags, *[0.0] * 5), 5.0)
        for flags in (0, 1 + 16, 0)
    ]
    assert verdicts == [[EstimatorStatusReported(5.0, 0.0, has)] for has in (None, True, False)]


@pytest.mark.parametrize(("health", "is_healthy"), [(0, False), (0x10000, True)])
def test_the_rc_input_is_healthy_or_lost_by_sys_status(health: int, is_healthy: bool) -> None:
    status = mavlink.MAVLink_sys_status_message(
        0x10000, 0x10000, health, 0, 0, -1, -1, 0, 0, 0, 0, 0, 0
    )
    assert RcStatusReported(5.0, is_healthy) in events(status)


def test_unknown_ratios_are_no_evidence() -> None:
    assert health_of(estimator_status(NAN, NAN, NAN, NAN)) == []


@pytest.mark.parametrize(
    ("fix_type", "expected"), [(0, False), (1, False), (2, False), (3, True), (6, True)]
)
def test_a_fix_has_three_dimensions(fix_type: int, expected: bool) -> None:
    assert health_of(gps(fix_type)) == [FixReported(5.0, expected)]


def test_a_fix_of_no_known_type_says_nothing() -> None:
    assert health_of(gps(200)) == []


def test_the_accuracy_of_a_fix_is_in_millimetres() -> None:
    expected = PositionAccuracyReported(5.0, AccuracySource.RECEIVER, 1.5, 2.25)
    assert rating_of(gps(6, h_acc=1500, v_acc=2250)) == expected


@pytest.mark.parametrize("unknown", [0, UINT32_MAX])
def test_an_accuracy_that_is_not_known_is_none(unknown: int) -> None:
    expected = PositionAccuracyReported(5.0, AccuracySource.RECEIVER, None, None)
    assert rating_of(gps(3, h_acc=unknown, v_acc=unknown)) == expected


@pytest.mark.parametrize("fix_type", [0, 1, 2, 200])
def test_without_a_fix_there_is_no_accuracy(fix_type: int) -> None:
    assert rating_of(gps(fix_type, h_acc=20, v_acc=30)).horizontal_m is None


@pytest.mark.parametrize(("h_acc", "sigma_m"), [(1, 0.01), (UINT32_MAX - 1, 1000.0)])
def test_an_accuracy_beyond_belief_counts_as_the_nearest_one(h_acc: int, sigma_m: float) -> None:
    assert rating_of(gps(h_acc=h_acc)).horizontal_m == sigma_m


@pytest.mark.parametrize(
    ("reported_m", "sigma_m"),
    [(0.3, 0.3), (0.0, None), (-1.0, None), (NAN, None), (INF, None), (1e30, 1000.0)],
)
def test_px4_tells_metres_and_nonsense_is_none(reported_m: float, sigma_m: float | None) -> None:
    ratios = (0.1,) * 6
    message = mavlink.MAVLink_estimator_status_message(0, 0, *ratios, reported_m, reported_m)
    expected = PositionAccuracyReported(5.0, AccuracySource.ESTIMATOR, sigma_m, sigma_m)
    assert rating_of(message) == expected


@pytest.mark.parametrize(
    ("percent", "charge_state", "charge_pct", "level"),
    [
        (80, mavlink.MAV_BATTERY_CHARGE_STATE_OK, 80.0, BatteryLevel.GOOD),
        (-1, mavlink.MAV_BATTERY_CHARGE_STATE_UNDEFINED, None, BatteryLevel.UNKNOWN),
        (-1, mavlink.MAV_BATTERY_CHARGE_STATE_LOW, None, BatteryLevel.LOW),
        (120, mavlink.MAV_BATTERY_CHARGE_STATE_EMERGENCY, None, BatteryLevel.CRITICAL),
        (0, 99, 0.0, BatteryLevel.UNKNOWN),
    ],
)
def test_charge_in_percent_and_as_a_state(
    percent: int, charge_state: int, charge_pct: float | None, level: BatteryLevel
) -> None:
    assert events(battery_status(percent, charge_state)) == [
        BatteryReported(5.0, charge_pct, level)
    ]


def test_sys_status_tells_the_charge_until_battery_status_does() -> None:
    inbound = VehicleInbound()
    assert inbound.events(sys_status(70), 5.0) == [BatteryReported(5.0, 70.0, BatteryLevel.UNKNOWN)]
    assert inbound.events(battery_status(60, number=1), 6.0) == []
    inbound.events(battery_status(70), 7.0)
    assert inbound.events(sys_status(70), 8.0) == []
    for step in range(10):  # the autopilot restarts: its stamps go back, and go on
        boot_ms = 90_000 if step == 0 else 100 * step
        attitude = mavlink.MAVLink_attitude_message(boot_ms, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        inbound.events(attitude, 8.0 + 0.1 * step)
    assert len(inbound.events(sys_status(70), 9.0)) == 1


def test_sticks_are_the_first_four_channels() -> None:
    assert events(rc_channels(1500, 1000, 2000, 1750)) == [
        SticksReported(5.0, (0.0, -1.0, 1.0, 0.5))
    ]


@pytest.mark.parametrize("pulse", [0, UINT16_MAX, 700])
def test_a_channel_without_a_pulse_is_no_stick(pulse: int) -> None:
    assert events(rc_channels(1500, pulse, 1500, 1500)) == []


def test_pulses_without_channels_are_no_sticks() -> None:
    """MAVLink, RC_CHANNELS.chancount: 0 when no RC channels are available."""
    assert events(rc_channels(900, 1500, 900, 1500, count=0)) == []
