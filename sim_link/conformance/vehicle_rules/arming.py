"""Arming and disarming: when it is refused, and what is said then."""

from __future__ import annotations

import math

from companion.mav.dialect import mavlink
from sim_link.conformance.results import (
    ACCEPTED,
    FAILED,
    REFUSALS,
    TEMPORARILY_REJECTED,
)
from sim_link.conformance.rules import (
    Effect,
    NotApplicable,
    Role,
    RuleBook,
    require,
)
from sim_link.conformance.sources import OBSERVED_ARDUPILOT, OBSERVED_PX4
from sim_link.conformance.vehicle_probe import ARM, FORCE, PREARM, VehicleProbe
from sim_link.conformance.vehicle_station import NAN

book = RuleBook(Role.VEHICLE, "arming")
SERVICE = "MAVLink guide, Command Protocol"
MODE = "MAVLink common, MAV_CMD_DO_SET_MODE"
STRICT = "(stricter than the real one, which accepts it)"
SET_MODE = mavlink.MAV_CMD_DO_SET_MODE


@book.rule(f"{SERVICE} (commands are idempotent)")
def disarming_the_disarmed_is_accepted(probe: VehicleProbe) -> None:
    """Disarming a disarmed vehicle is ACCEPTED."""
    if probe.is_armed():
        raise NotApplicable("the vehicle is armed")
    require(probe.command(ARM, 0.0, 0.0) == ACCEPTED, "refused")


@book.rule(
    f"{OBSERVED_PX4}; {OBSERVED_ARDUPILOT}",
    effect=Effect.FLIES,
    px4="TEMPORARILY_REJECTED",
    ardupilot="FAILED, with the reason as texts",
)
def arming_before_ready_is_refused(probe: VehicleProbe) -> None:
    """Right after boot arming is refused, forced or not, and a text says why."""
    probe.set_interval(mavlink.MAVLINK_MSG_ID_SYS_STATUS, 0.1)
    probe.run(0.5)
    status = probe.latest(mavlink.MAVLink_sys_status_message)
    if status.onboard_control_sensors_health & PREARM:
        raise NotApplicable("it is ready already; seen only right after boot")
    wanted = TEMPORARILY_REJECTED if probe.is_px4 else FAILED
    mark = probe.mark
    for force in (0.0, FORCE) if probe.is_px4 else (0.0,):
        result = probe.command(ARM, 1.0, force)
        require(result == wanted, f"force {force:g}: result {result}, not {wanted}")
    probe.expect(mavlink.MAVLink_statustext_message, mark=mark, what="text with the reason")


@book.rule(f"{SERVICE} {STRICT}", effect=Effect.FLIES)
def senseless_arming_is_refused(probe: VehicleProbe) -> None:
    """Arming with NaN, a fraction or 2 is refused and arms nothing."""
    probe.get_ready()
    for wanted in (NAN, 0.4, 2.0, -1.0, math.inf):
        result = probe.command(ARM, wanted, 0.0)
        require(result in REFUSALS, f"param1 {wanted}: result {result}")
    require(not probe.is_armed(), "it is armed")


@book.rule(f"{SERVICE} (commands are idempotent)", effect=Effect.FLIES)
def arming_the_armed_is_accepted(probe: VehicleProbe) -> None:
    """Arming an armed vehicle is ACCEPTED and changes nothing."""
    probe.arm()
    require(probe.command(ARM, 1.0, 0.0) == ACCEPTED, "refused")
    require(probe.is_armed(), "not armed any more")


@book.rule(
    f"{OBSERVED_PX4}; {OBSERVED_ARDUPILOT}",
    effect=Effect.FLIES,
    px4="TEMPORARILY_REJECTED",
    ardupilot="FAILED, with a text",
)
def arming_in_a_mode_that_cannot_is_refused(probe: VehicleProbe) -> None:
    """In LAND and RETURN arming is refused."""
    probe.get_ready()
    wanted = TEMPORARILY_REJECTED if probe.is_px4 else FAILED
    for mode in ("land", "return"):
        probe.set_mode(mode)
        result = probe.command(ARM, 1.0, 0.0)
        require(result == wanted, f"in {mode}: result {result}, not {wanted}")


@book.rule(
    f"MAVLink common, MAV_CMD_COMPONENT_ARM_DISARM; {OBSERVED_PX4}; {OBSERVED_ARDUPILOT}",
    effect=Effect.FLIES,
    px4="TEMPORARILY_REJECTED",
    ardupilot="FAILED",
)
def disarming_in_the_air_is_refused(probe: VehicleProbe) -> None:
    """In the air disarming is refused unless it is forced."""
    probe.take_off()
    wanted = TEMPORARILY_REJECTED if probe.is_px4 else FAILED
    result = probe.command(ARM, 0.0, 0.0)
    require(result == wanted, f"result {result}, not {wanted}")
    require(probe.is_armed(), "it is disarmed")
    require(probe.command(ARM, 0.0, FORCE) == ACCEPTED, "a forced disarm is refused")
    require(not probe.is_armed(), "a forced disarm does nothing")


@book.rule(f"PX4 COM_DISARM_PRFLT (10 s); {OBSERVED_ARDUPILOT}", effect=Effect.FLIES)
def idle_vehicle_disarms(probe: VehicleProbe) -> None:
    """Armed and left on the ground it disarms by itself after about 10 s."""
    probe.arm()
    probe.run(5.0)
    require(probe.is_armed(), "disarmed after 5 s already")
    probe.await_disarmed(9.0)
