"""What a vehicle does by itself when something is lost, and how it tells."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from companion.mav.dialect import mavlink
from sim_link.conformance.parameter_client import (
    INT32,
    REAL32,
    await_value,
    float_name,
    read,
    write,
)
from sim_link.conformance.rules import (
    ARDUPILOT_ONLY,
    PX4_ONLY,
    Effect,
    Role,
    RuleBook,
    require,
)
from sim_link.conformance.sources import OBSERVED_ARDUPILOT
from sim_link.conformance.vehicle_probe import VehicleProbe
from sim_link.conformance.vehicle_rules.offboard import begin

book = RuleBook(Role.VEHICLE, "failsafes")
PX4_SAFETY = "PX4 user guide, Safety Configuration"
PX4_OFFBOARD = "PX4 user guide, Offboard Mode, COM_OF_LOSS_T"
FLIES = Effect.FLIES
HOLD_BEFORE_S = 6.0
"""PX4 holds for COM_FAIL_ACT_T, 5 s by default, before it returns."""
CRITICAL = mavlink.MAV_STATE_CRITICAL
OFFBOARD_NUMBER = 6 << 16


@contextmanager
def parameter_set(probe: VehicleProbe, name: str, value: float) -> Iterator[None]:
    """A parameter that is restored at the end."""
    before = read(probe, name)
    await_value(probe, write(probe, name, value, before.kind), name)
    try:
        yield
    finally:
        write(probe, name, before.value(probe), before.kind)
        probe.run(0.2)


@contextmanager
def silence(probe: VehicleProbe) -> Iterator[None]:
    """Our own heartbeat stops for a while."""
    probe.be_silent()
    try:
        yield
    finally:
        probe.be_heard()


@book.rule(
    f"{OBSERVED_ARDUPILOT}, FS_GCS_ENABLE, SYSID_MYGCS", effect=FLIES, flavours=ARDUPILOT_ONLY
)
def lost_ground_station_returns(probe: VehicleProbe) -> None:
    """With FS_GCS_ENABLE, five seconds without the ground station's heartbeat: RTL, CRITICAL."""
    with parameter_set(probe, "FS_GCS_ENABLE", 1.0):
        probe.take_off()
        mark = probe.mark
        with silence(probe):
            probe.run(3.5)
            require(probe.is_in("offboard"), "RTL before 5 s")
            probe.await_mode("return", 5.0)
            beat = probe.heartbeat()
        require(beat.system_status == CRITICAL, f"system_status {beat.system_status}")
        texts = [m.text for m in probe.heard_since(mavlink.MAVLink_statustext_message, mark)]
        require(any("GCS" in text for text in texts), f"texts {texts}")


@book.rule(OBSERVED_ARDUPILOT, effect=FLIES, flavours=ARDUPILOT_ONLY)
def lost_ground_station_is_nothing_by_default(probe: VehicleProbe) -> None:
    """Without FS_GCS_ENABLE a silent ground station changes nothing."""
    probe.take_off()
    with silence(probe):
        probe.run(9.0)
        require(probe.is_in("offboard"), "it left GUIDED")


@book.rule(f"{PX4_SAFETY}, NAV_DLL_ACT, COM_DL_LOSS_T", effect=FLIES, flavours=PX4_ONLY)
def lost_data_link_returns(probe: VehicleProbe) -> None:
    """With NAV_DLL_ACT 2, COM_DL_LOSS_T without a ground station: Hold for a while, RETURN."""
    with parameter_set(probe, "NAV_DLL_ACT", 2.0), parameter_set(probe, "COM_DL_LOSS_T", 5.0):
        probe.take_off()
        with silence(probe):
            probe.run(3.0)
            require(probe.is_in("hold"), "RETURN before 5 s")
            probe.await_mode("return", 5.0 + HOLD_BEFORE_S)
            beat = probe.heartbeat()
        require(beat.system_status == CRITICAL, f"system_status {beat.system_status}")


@book.rule(PX4_OFFBOARD, effect=FLIES, flavours=PX4_ONLY)
def offboard_loss_time_is_the_parameter(probe: VehicleProbe) -> None:
    """COM_OF_LOSS_T says how long setpoints may be missing."""
    require(read(probe, "COM_OF_LOSS_T").kind == REAL32, "COM_OF_LOSS_T is no float")
    require(read(probe, "COM_OBL_RC_ACT").kind == INT32, "COM_OBL_RC_ACT is no integer")
    with parameter_set(probe, "COM_OF_LOSS_T", 4.0):
        stop = begin(probe)
        stop()
        probe.run(2.5)
        early = probe.request(mavlink.MAVLink_heartbeat_message)
        require(early.custom_mode == OFFBOARD_NUMBER, "lost after 2.5 s")
        probe.run(2.5)
        late = probe.request(mavlink.MAVLink_heartbeat_message)
        require(late.custom_mode != OFFBOARD_NUMBER, "not lost after 5 s")


@book.rule("MAVLink common, MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN; SYSTEM_TIME", effect=Effect.CHANGES)
def reboot_restarts_the_clock_and_keeps_parameters(probe: VehicleProbe) -> None:
    """Disarmed it reboots on command: time_boot_ms begins anew, changed parameters stay."""
    probe.get_ready()
    name = float_name(probe)
    before = read(probe, name)
    await_value(probe, write(probe, name, 4.5, REAL32), name)
    probe.run(2.0)
    old_ms = probe.request(mavlink.MAVLink_system_time_message).time_boot_ms
    probe.reboot()
    new_ms = probe.request(mavlink.MAVLink_system_time_message).time_boot_ms
    kept = read(probe, name).value(probe)
    write(probe, name, before.value(probe), REAL32)
    probe.run(0.2)
    require(new_ms < old_ms, f"time_boot_ms went from {old_ms} to {new_ms}")
    require(kept == 4.5, f"{name} is {kept} after the reboot")
