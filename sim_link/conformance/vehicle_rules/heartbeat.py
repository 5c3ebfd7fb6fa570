"""HEARTBEAT: how often, who says it, and how mode, arming and state are told."""

from __future__ import annotations

import itertools

from companion.mav.dialect import mavlink
from sim_link.conformance import modes
from sim_link.conformance.rules import (
    ARDUPILOT_ONLY,
    PX4_ONLY,
    Effect,
    NotApplicable,
    Role,
    RuleBook,
    require,
)
from sim_link.conformance.sources import OBSERVED_ARDUPILOT, OBSERVED_PX4
from sim_link.conformance.station import brief
from sim_link.conformance.vehicle_probe import ARM, FORCE, PREARM, VehicleProbe
from sim_link.conformance.vehicle_station import ACCEPTED, ARMED

book = RuleBook(Role.VEHICLE, "heartbeat")
SERVICE = "MAVLink guide, Heartbeat/Connection Protocol"
PX4_MODES = "PX4 px4_custom_mode.h; MAVSDK px4_custom_mode.h"
ARDUPILOT_MODES = "ArduPilot ArduCopter/mode.h"
COPTERS = (
    mavlink.MAV_TYPE_QUADROTOR,
    mavlink.MAV_TYPE_HEXAROTOR,
    mavlink.MAV_TYPE_OCTOROTOR,
    mavlink.MAV_TYPE_TRICOPTER,
    mavlink.MAV_TYPE_HELICOPTER,
    mavlink.MAV_TYPE_COAXIAL,
)
PERIODS = 5
JITTER_S = 0.25


@book.rule(SERVICE)
def once_a_second(probe: VehicleProbe) -> None:
    """HEARTBEAT comes once a second."""
    probe.run(PERIODS + 1.0)
    times = [
        entry.time_s
        for entry in probe.inbox
        if isinstance(entry.message, mavlink.MAVLink_heartbeat_message)
        and entry.source == probe.target
    ]
    require(len(times) >= PERIODS, f"{len(times)} in {PERIODS + 1} s")
    for first, second in itertools.pairwise(times):
        gap_s = second - first
        require(abs(gap_s - 1.0) < JITTER_S, f"{gap_s:.2f} s between two")


@book.rule(SERVICE + "; MAVSDK system_impl.cpp is_autopilot")
def comes_from_component_one(probe: VehicleProbe) -> None:
    """The autopilot is component 1: MAVSDK takes no other for one."""
    require(probe.target[1] == mavlink.MAV_COMP_ID_AUTOPILOT1, f"component {probe.target[1]}")


@book.rule(SERVICE)
def tells_type_and_autopilot(probe: VehicleProbe) -> None:
    """HEARTBEAT tells a multicopter, the flavour's autopilot and MAVLink version 3."""
    message = probe.heartbeat()
    require(message.type in COPTERS, f"type {message.type}")
    require(
        message.autopilot == modes.AUTOPILOT_OF[probe.flavour], f"autopilot {message.autopilot}"
    )
    require(message.mavlink_version == 3, f"mavlink_version {message.mavlink_version}")


@book.rule("MAVSDK mavsdk_impl.cpp (255/190 is the ground station)")
def is_no_ground_station(probe: VehicleProbe) -> None:
    """The vehicle is not at a ground station's address."""
    require(probe.target != (255, 190), "the vehicle is 255/190")


@book.rule("MAVLink common, MAV_MODE_FLAG")
def custom_mode_flag_is_set(probe: VehicleProbe) -> None:
    """base_mode has CUSTOM_MODE_ENABLED."""
    message = probe.heartbeat()
    require(bool(message.base_mode & modes.CUSTOM), f"base_mode {message.base_mode}")


def check_modes(probe: VehicleProbe, table: dict[str, int]) -> None:
    """Choose each mode of a table, disarmed; HEARTBEAT must show it."""
    if probe.is_armed():
        raise NotApplicable("the vehicle is armed")
    try:
        for mode, base_mode in table.items():
            result = probe.set_mode(mode)
            require(result == ACCEPTED, f"{mode}: result {result}")
            probe.await_mode(mode, 3.0)
            shown = probe.heartbeat().base_mode & ~mavlink.MAV_MODE_FLAG_HIL_ENABLED
            require(shown == base_mode, f"{mode}: base_mode {shown:#x}, not {base_mode:#x}")
    finally:
        probe.set_mode("hold" if probe.is_px4 else "stabilized")


@book.rule(f"{PX4_MODES}; {OBSERVED_PX4}", effect=Effect.CHANGES, flavours=PX4_ONLY)
def px4_modes_are_packed(probe: VehicleProbe) -> None:
    """custom_mode is main << 16 | sub << 24, and base_mode has the flags that PX4 sends."""
    names = ("hold", "land", "return", "takeoff")
    check_modes(probe, {name: modes.PX4_BASE_MODE[name] for name in names})


@book.rule(f"{PX4_MODES}; {OBSERVED_PX4}", effect=Effect.CHANGES, flavours=PX4_ONLY)
def px4_stick_modes_are_packed(probe: VehicleProbe) -> None:
    """POSCTL and ALTCTL are shown with the manual-input and stabilise flags."""
    names = ("position", "altitude")
    check_modes(probe, {name: modes.PX4_BASE_MODE[name] for name in names})


@book.rule(
    f"{ARDUPILOT_MODES}; {OBSERVED_ARDUPILOT}", effect=Effect.CHANGES, flavours=ARDUPILOT_ONLY
)
def ardupilot_modes_are_numbered(probe: VehicleProbe) -> None:
    """custom_mode is ArduCopter's mode number, and base_mode has the flags that it sends."""
    probe.get_ready()
    check_modes(probe, {k: v for k, v in modes.ARDUCOPTER_BASE_MODE.items() if k != "mission"})


@book.rule(OBSERVED_ARDUPILOT, effect=Effect.CHANGES, flavours=ARDUPILOT_ONLY)
def mode_change_is_told_at_once(probe: VehicleProbe) -> None:
    """A changed mode is told by a HEARTBEAT of its own, without waiting for the next second."""
    probe.set_mode("stabilized")
    probe.heartbeat()
    probe.run(0.2)
    mark = probe.mark
    probe.set_mode("altitude")
    probe.expect(
        mavlink.MAVLink_heartbeat_message,
        lambda m: m.custom_mode == modes.ARDUCOPTER["altitude"],
        within_s=0.4,
        mark=mark,
    )
    probe.set_mode("stabilized")


@book.rule(f"MAVLink common, MAV_STATE; {OBSERVED_PX4}")
def disarmed_and_ready_is_standby(probe: VehicleProbe) -> None:
    """Disarmed and ready to arm, system_status is STANDBY."""
    probe.get_ready()
    message = probe.heartbeat()
    require(message.system_status == mavlink.MAV_STATE_STANDBY, brief(message))


@book.rule(f"MAVLink common, MAV_STATE; {OBSERVED_PX4}", flavours=PX4_ONLY)
def not_ready_is_uninit(probe: VehicleProbe) -> None:
    """While arming would be refused, system_status is UNINIT and the prearm bit is bad."""
    status = probe.expect(mavlink.MAVLink_sys_status_message, within_s=3.0)
    if status.onboard_control_sensors_health & PREARM:
        raise NotApplicable("it is ready already; seen only right after boot")
    message = probe.from_vehicle(mavlink.MAVLink_heartbeat_message)[-1]
    require(message.system_status == mavlink.MAV_STATE_UNINIT, brief(message))


@book.rule("MAVLink common, MAV_MODE_FLAG_SAFETY_ARMED", effect=Effect.FLIES)
def armed_flag_follows_arming(probe: VehicleProbe) -> None:
    """base_mode has SAFETY_ARMED exactly while the vehicle is armed."""
    require(not probe.is_armed(), "SAFETY_ARMED before arming")
    probe.arm()
    require(probe.is_armed(), "no SAFETY_ARMED after arming")
    require(probe.command(ARM, 0.0, FORCE) == ACCEPTED, "a forced disarm is refused")
    require(not probe.is_armed(), "SAFETY_ARMED after disarming")


@book.rule(
    "MAVLink common, MAV_STATE",
    effect=Effect.FLIES,
    ardupilot="ArduCopter stays STANDBY while armed on the ground, ACTIVE in the air",
)
def armed_and_flying_is_active(probe: VehicleProbe) -> None:
    """In the air system_status is ACTIVE."""
    probe.arm()
    on_ground = probe.heartbeat()
    require(bool(on_ground.base_mode & ARMED), brief(on_ground))
    wanted = mavlink.MAV_STATE_ACTIVE if probe.is_px4 else mavlink.MAV_STATE_STANDBY
    require(on_ground.system_status == wanted, f"armed on the ground: {brief(on_ground)}")
    probe.take_off()
    flying = probe.heartbeat()
    require(flying.system_status == mavlink.MAV_STATE_ACTIVE, f"in the air: {brief(flying)}")
