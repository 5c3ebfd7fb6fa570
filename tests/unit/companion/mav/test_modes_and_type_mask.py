from __future__ import annotations

import pytest

from companion.domain import Autopilot, FlightMode, VehicleClass
from companion.mav import dialect
from companion.mav.dialect import mavlink
from companion.mav.flight_modes import (
    ARDUCOPTER_NUMBER,
    ARDUPILOT_MODE_NAMES,
    CLASS_OF_TYPE,
    PX4_MAIN_AND_SUB,
    autopilot_of,
    mode_of,
    other_mode_name,
    px4_custom_mode,
    px4_mode,
    set_mode_params,
)


def heartbeat(custom_mode: int, autopilot: int = 12) -> mavlink.MAVLink_heartbeat_message:
    return mavlink.MAVLink_heartbeat_message(2, autopilot, 1, custom_mode, 4, 3)


@pytest.mark.parametrize("mode", PX4_MAIN_AND_SUB)
def test_a_px4_mode_is_read_back(mode: FlightMode) -> None:
    assert mode_of(heartbeat(px4_custom_mode(mode)), Autopilot.PX4) is mode


@pytest.mark.parametrize("mode", ARDUCOPTER_NUMBER)
def test_an_arducopter_mode_is_read_back(mode: FlightMode) -> None:
    message = heartbeat(ARDUCOPTER_NUMBER[mode], 3)
    assert mode_of(message, Autopilot.ARDUPILOT) is mode


@pytest.mark.parametrize(
    ("custom_mode", "mode"),
    [
        (0x0006_0000, FlightMode.OFFBOARD),
        (0x0304_0000, FlightMode.HOLD),
        (0x0504_0000, FlightMode.RETURN),
        (0x0604_0000, FlightMode.LAND),
        (0x0003_0000, FlightMode.POSITION),
        (0x0103_0000, FlightMode.POSITION),  # POSCTL's own sub modes (orbit, slow) are flown alike
        (0, FlightMode.UNKNOWN),
        (0x6304_0000, FlightMode.UNKNOWN),
        (0xFFFF_FFFF, FlightMode.UNKNOWN),
    ],
)
def test_px4_numbers_as_its_firmware_packs_them(custom_mode: int, mode: FlightMode) -> None:
    assert mode_of(heartbeat(custom_mode), Autopilot.PX4) is mode


@pytest.mark.parametrize(
    ("mode", "enum_name"),
    [
        (FlightMode.STABILIZED, "COPTER_MODE_STABILIZE"),
        (FlightMode.ACRO, "COPTER_MODE_ACRO"),
        (FlightMode.ALTITUDE, "COPTER_MODE_ALT_HOLD"),
        (FlightMode.MISSION, "COPTER_MODE_AUTO"),
        (FlightMode.OFFBOARD, "COPTER_MODE_GUIDED"),
        (FlightMode.POSITION, "COPTER_MODE_LOITER"),
        (FlightMode.RETURN, "COPTER_MODE_RTL"),
        (FlightMode.LAND, "COPTER_MODE_LAND"),
        (FlightMode.HOLD, "COPTER_MODE_BRAKE"),
    ],
)
def test_arducopter_numbers_are_those_of_its_own_dialect(mode: FlightMode, enum_name: str) -> None:
    from pymavlink.dialects.v20 import ardupilotmega

    assert ARDUCOPTER_NUMBER[mode] == getattr(ardupilotmega, enum_name)


@pytest.mark.parametrize(
    ("enum_name", "vehicle_class"),
    [
        ("COPTER_MODE", VehicleClass.MULTICOPTER),
        ("COPTER_MODE", VehicleClass.HELICOPTER),
        ("PLANE_MODE", VehicleClass.FIXED_WING),
        ("PLANE_MODE", VehicleClass.VTOL),
        ("ROVER_MODE", VehicleClass.ROVER),
        ("ROVER_MODE", VehicleClass.BOAT),
        ("SUB_MODE", VehicleClass.SUBMARINE),
        ("TRACKER_MODE", VehicleClass.TRACKER),
    ],
)
def test_every_mode_of_ardupilot_has_the_name_of_its_own_dialect(
    enum_name: str, vehicle_class: VehicleClass
) -> None:
    from pymavlink.dialects.v20 import ardupilotmega

    entries = ardupilotmega.enums[enum_name].items()
    names = {number: entry.name.removeprefix(f"{enum_name}_") for number, entry in entries}
    assert {n: name for n, name in names.items() if name != "ENUM_END"} == (
        ARDUPILOT_MODE_NAMES[vehicle_class]
    )


@pytest.mark.parametrize("autopilot", [Autopilot.PX4, Autopilot.ARDUPILOT])
@pytest.mark.parametrize("vehicle_type", [1, 0, 5, 10, 11, 12, 16, 19, 20, 21, 22, 23, 24, 25, 28])
def test_no_number_of_a_class_that_is_not_flown_is_a_mode_of_ours(
    autopilot: Autopilot, vehicle_type: int
) -> None:
    for number in range(31):
        for custom_mode in (number, number << 16, 4 << 16 | number << 24):
            message = mavlink.MAVLink_heartbeat_message(vehicle_type, 3, 129, custom_mode, 4, 3)
            assert mode_of(message, autopilot) is FlightMode.UNKNOWN, custom_mode


def test_the_same_number_has_the_name_of_its_class() -> None:
    plane = mavlink.MAVLink_heartbeat_message(1, 3, 129, 4, 4, 3)
    assert other_mode_name(plane, Autopilot.ARDUPILOT) == "ACRO"
    plane.custom_mode = 17
    assert other_mode_name(plane, Autopilot.ARDUPILOT) == "QSTABILIZE"


def test_every_mav_type_is_a_class_or_flies_nothing() -> None:
    flown = {number for number, each in CLASS_OF_TYPE.items() if each.is_flown}
    assert flown == {2, 3, 4, 13, 14, 15, 29, 35, 43}
    nothing = {entry for entry in mavlink.enums["MAV_TYPE"] if entry not in CLASS_OF_TYPE}
    assert {6, 18, 26, 27, 30} <= nothing


def test_a_mode_without_a_name_is_reported_by_its_number() -> None:
    assert other_mode_name(heartbeat(21, 3), Autopilot.ARDUPILOT) == "SMART_RTL"
    assert other_mode_name(heartbeat(99, 3), Autopilot.ARDUPILOT) == "MODE_99"
    assert other_mode_name(heartbeat(30, 3), Autopilot.ARDUPILOT) == "OFFBOARD"
    assert other_mode_name(heartbeat(0x1404_0000), Autopilot.PX4) == "descend"
    assert other_mode_name(heartbeat(0x0B04_0000), Autopilot.PX4) == "external mode 1"
    assert other_mode_name(heartbeat(0x6304_0000), Autopilot.PX4) == "mode 4/99"


def test_an_unknown_autopilot_has_unknown_modes() -> None:
    assert mode_of(heartbeat(4, 5), Autopilot.OTHER) is FlightMode.UNKNOWN


@pytest.mark.parametrize(
    ("number", "autopilot"),
    [
        (mavlink.MAV_AUTOPILOT_PX4, Autopilot.PX4),
        (mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, Autopilot.ARDUPILOT),
        (mavlink.MAV_AUTOPILOT_INVALID, None),
        (mavlink.MAV_AUTOPILOT_GENERIC, None),
        (mavlink.MAV_AUTOPILOT_OPENPILOT, Autopilot.OTHER),
    ],
)
def test_the_autopilot_is_reported_from_its_heartbeat(
    number: int, autopilot: Autopilot | None
) -> None:
    assert autopilot_of(heartbeat(0, number)) is autopilot


def test_px4_ignores_a_sub_mode_outside_auto_and_refuses_unknown_ones() -> None:
    assert px4_mode(6, 9) is FlightMode.OFFBOARD
    assert px4_mode(4, 99) is None
    assert px4_mode(99, 0) is None


def test_setting_a_mode_keeps_the_armed_flag_as_it_is() -> None:
    assert set_mode_params(FlightMode.OFFBOARD, Autopilot.PX4, is_armed=True) == (129.0, 6.0, 0.0)
    assert set_mode_params(FlightMode.HOLD, Autopilot.PX4, is_armed=False) == (1.0, 4.0, 3.0)
    assert set_mode_params(FlightMode.HOLD, Autopilot.ARDUPILOT, is_armed=True) == (129, 17, 0)


def test_a_mode_that_the_autopilot_does_not_have_is_a_key_error() -> None:
    with pytest.raises(KeyError):
        set_mode_params(FlightMode.TAKEOFF, Autopilot.ARDUPILOT, is_armed=True)


@pytest.mark.parametrize("field", ["X", "Y", "Z", "VX", "VY", "VZ", "AX", "AY", "AZ", "YAW"])
def test_every_ignore_bit_is_that_of_the_dialect(field: str) -> None:
    ours = getattr(dialect, f"{field}_IGNORE")
    assert ours == getattr(mavlink, f"POSITION_TARGET_TYPEMASK_{field}_IGNORE")


def test_the_other_bits_are_those_of_the_dialect() -> None:
    assert dialect.YAW_RATE_IGNORE == mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE
    assert dialect.FORCE_SET == mavlink.POSITION_TARGET_TYPEMASK_FORCE_SET


def test_the_masks_we_send_are_those_that_mavsdk_sends() -> None:
    assert dialect.POSITION_ONLY == 0x0DF8
    assert dialect.POSITION_AND_YAW == 0x09F8
    assert not dialect.POSITION_ONLY & dialect.FORCE_SET
