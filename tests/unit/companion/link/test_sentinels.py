"""Every field of every report that is read, with every value that means "unknown", or nothing.

Source: MAVLink common: INT32_MAX, UINT16_MAX, -1, 0/0 and NaN stand for unknown values.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import fields, is_dataclass

import pytest

from companion.guidance.events import Event
from companion.guidance.vehicle import VehicleView
from companion.link.inbound import VehicleInbound
from companion.mav.dialect import MAVLink_ekf_status_report_message, Message, mavlink
from tests.unit.companion.link.wire import E7, heartbeat, home_position, local_position, origin

FLOATS = (math.nan, math.inf, -math.inf, 1e30, -1e30, 3.4e38)
INTEGERS = {
    "int8_t": (-(2**7), -1, 2**7 - 1),
    "uint8_t": (0, 2**8 - 1),
    "int16_t": (-(2**15), -1, 2**15 - 1),
    "uint16_t": (0, 2**16 - 1),
    "int32_t": (-(2**31), 0, 2**31 - 1),
    "uint32_t": (0, 2**32 - 1),
    "uint64_t": (0, 2**64 - 1),
}
STICKS = [1500] * 18 + [200]
"""Pulses of all channels, and the signal strength."""
CLOCK = frozenset({"time_boot_ms", "time_usec"})
BEYOND = frozenset({"LOCAL_POSITION_NED", "ESTIMATOR_STATUS", "EKF_STATUS_REPORT"})
"""The vehicle's view judges positions; ratios of an estimator that fails have no upper end."""
MAX_FLOAT = 1e6
"""Metres, percent, radians, degrees or volts: no report of a flight says more."""


def reports() -> dict[str, Message]:
    """A good one of each kind."""
    rated = (0.1, 0.1, 0.1, 0.1)
    found = (
        heartbeat(),
        local_position(1000, 1.0, 2.0, -20.0, 0.0, 0.0, 0.0),
        mavlink.MAVLink_attitude_message(1000, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0),
        mavlink.MAVLink_extended_sys_state_message(0, 2),
        mavlink.MAVLink_sys_status_message(0, 0, 0, 100, 12000, 100, 80, 0, 0, 0, 0, 0, 0),
        origin(),
        home_position(),
        mavlink.MAVLink_battery_status_message(0, 0, 0, 2000, [4000] * 10, 100, 10, 10, 80),
        mavlink.MAVLink_gps_raw_int_message(0, 3, 47 * E7, 8 * E7, 500_000, 100, 100, 0, 0, 12),
        mavlink.MAVLink_estimator_status_message(0, 0, *rated, 0.1, 0.1, 0.1, 0.1),
        MAVLink_ekf_status_report_message(0, *rated, 0.1, 0.1),
        mavlink.MAVLink_position_target_local_ned_message(
            1000, 1, 0, 1.0, 2.0, -20.0, *([0.0] * 8)
        ),
        mavlink.MAVLink_rc_channels_message(1000, 8, *STICKS),
    )
    return {message.get_type(): message for message in found}


def spoilt() -> Iterator[tuple[str, str, float]]:
    for name, message in reports().items():
        for field, kind in zip(message.fieldnames, message.fieldtypes, strict=True):
            if field not in CLOCK and not isinstance(getattr(message, field), list):
                values = FLOATS if kind == "float" else INTEGERS.get(kind, ())
                yield from ((name, field, value) for value in values)


def numbers(value: object) -> Iterator[float]:
    """Every number in an event."""
    if is_dataclass(value):
        for field in fields(value):
            yield from numbers(getattr(value, field.name))
    elif isinstance(value, tuple | list):
        for part in value:
            yield from numbers(part)
    elif isinstance(value, float):
        yield value


def known_after(message: Message) -> tuple[VehicleView, list[Event]]:
    """Return the session's view of the vehicle after good reports, and then this one."""
    inbound, vehicle, now_s = VehicleInbound(), VehicleView(), 10.0
    for good in reports().values():
        for event in inbound.events(good, now_s):
            vehicle.handle(event)
    if hasattr(message, "time_boot_ms"):
        message.time_boot_ms += 100
    events = inbound.events(message, now_s + 0.1)
    for event in events:
        vehicle.handle(event)
    return vehicle, events


@pytest.mark.parametrize("name", sorted({name for name, _, _ in spoilt()}))
def test_unknown_values_are_never_numbers(name: str) -> None:
    for field, value in [(field, value) for other, field, value in spoilt() if other == name]:
        message = reports()[name]
        setattr(message, field, value)
        vehicle, events = known_after(message)
        known = [vehicle.motion, vehicle.origin, vehicle.battery_pct, vehicle.track.latest_yaw]
        for number in (*numbers(known), *numbers([] if name in BEYOND else events)):
            assert math.isfinite(number), (field, value)
            assert abs(number) <= MAX_FLOAT, (field, value)


def test_the_good_ones_are_known() -> None:
    vehicle, events = known_after(reports()["ATTITUDE"])
    assert vehicle.motion is not None
    assert vehicle.battery_pct == 80.0
    assert vehicle.origin is not None
    assert vehicle.track.latest_yaw is not None
    assert events
