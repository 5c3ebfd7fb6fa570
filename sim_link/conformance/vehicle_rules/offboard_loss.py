"""PX4's OFFBOARD: the stream it needs, what ends it, and what brings it back."""

from __future__ import annotations

from companion.mav.dialect import mavlink
from sim_link.conformance.parameter_client import INT32, await_value, read, write
from sim_link.conformance.rules import PX4_ONLY, Effect, Role, RuleBook, require
from sim_link.conformance.setpoints import (
    POSITION,
    LocalSetpoint,
)
from sim_link.conformance.vehicle_probe import ARM, VehicleProbe, nothing_moved
from sim_link.conformance.vehicle_probe import FORCE as FORCE_DISARM
from sim_link.conformance.vehicle_rules.offboard import begin, fly, follow, here, invalid_setpoints
from sim_link.conformance.vehicle_station import ACCEPTED

book = RuleBook(Role.VEHICLE, "offboard_loss")
PX4_PAGE = "PX4 user guide, Offboard Mode"
OBSERVED = "PX4 1.15, observed in SITL"
FLIES = Effect.FLIES
TEMPORARILY_REJECTED = 1
CRITICAL, ACTIVE = mavlink.MAV_STATE_CRITICAL, mavlink.MAV_STATE_ACTIVE
LOSS_MODES = {0: "position", 3: "return", 4: "land", 5: "hold"}


@book.rule(f"{PX4_PAGE}; {OBSERVED}", effect=FLIES, flavours=PX4_ONLY)
def offboard_needs_a_stream_in_the_air(probe: VehicleProbe) -> None:
    """In the air OFFBOARD is refused without a stream, and given with one."""
    probe.take_off()
    result = probe.set_mode("offboard")
    require(result == TEMPORARILY_REJECTED, f"without a stream: result {result}")
    setpoint = here(probe)
    probe.enter_offboard(lambda: setpoint.message(probe.target))()


@book.rule(f"{PX4_PAGE}; {OBSERVED}", effect=FLIES, flavours=PX4_ONLY)
def offboard_without_a_stream_cannot_be_armed(probe: VehicleProbe) -> None:
    """Disarmed OFFBOARD is given without a stream, but arming is refused until there is one."""
    probe.get_ready()
    require(probe.set_mode("offboard") == ACCEPTED, "OFFBOARD is refused on the ground")
    result = probe.command(ARM, 1.0, 0.0)
    require(result == TEMPORARILY_REJECTED, f"armed without a stream: result {result}")
    setpoint = here(probe)
    stop = probe.stream(lambda: setpoint.message(probe.target))
    probe.run(1.5)
    require(probe.command(ARM, 1.0, 0.0) == ACCEPTED, "refused with a stream")
    require(probe.command(ARM, 0.0, FORCE_DISARM) == ACCEPTED, "disarming is refused")
    stop()
    probe.set_mode("hold")


@book.rule(f"{PX4_PAGE}, COM_OF_LOSS_T; {OBSERVED}", effect=FLIES, flavours=PX4_ONLY)
def lost_stream_is_a_failsafe(probe: VehicleProbe) -> None:
    """A second without setpoints ends OFFBOARD: another mode, and system_status CRITICAL."""
    stop = begin(probe)
    stop()
    probe.run(0.7)
    probe.request(mavlink.MAVLink_heartbeat_message)
    beat = probe.latest(mavlink.MAVLink_heartbeat_message)
    require(beat.system_status == ACTIVE, "failsafe before COM_OF_LOSS_T")
    probe.run(1.0)
    beat = probe.request(mavlink.MAVLink_heartbeat_message)
    require(beat.system_status == CRITICAL, f"system_status {beat.system_status}")
    require(beat.custom_mode != 6 << 16, "still OFFBOARD")


@book.rule(f"{PX4_PAGE}, COM_OBL_RC_ACT; {OBSERVED}", effect=FLIES, flavours=PX4_ONLY)
def loss_action_is_the_parameter(probe: VehicleProbe) -> None:
    """The mode after the loss is COM_OBL_RC_ACT's: position, return, land or hold."""
    before = read(probe, "COM_OBL_RC_ACT")
    stop = begin(probe)
    setpoint = here(probe)
    stop()
    try:
        for action, mode in LOSS_MODES.items():
            mark = write(probe, "COM_OBL_RC_ACT", float(action), INT32)
            await_value(probe, mark, "COM_OBL_RC_ACT")
            follow(probe, setpoint, 3.0)
            probe.await_mode(mode, 4.0)
    finally:
        write(probe, "COM_OBL_RC_ACT", before.value(probe), INT32)
        probe.run(0.2)


@book.rule(OBSERVED, effect=FLIES, flavours=PX4_ONLY)
def returning_stream_returns_offboard(probe: VehicleProbe) -> None:
    """When the setpoints come back, OFFBOARD comes back without a command."""
    stop = begin(probe)
    setpoint = here(probe)
    stop()
    probe.run(2.5)
    require(not probe.is_in("offboard"), "no failsafe")
    stop = probe.stream(lambda: setpoint.message(probe.target))
    probe.await_mode("offboard", 3.0)
    stop()


@book.rule(OBSERVED, effect=FLIES, flavours=PX4_ONLY)
def chosen_mode_ends_the_wish_for_offboard(probe: VehicleProbe) -> None:
    """A mode chosen during the failsafe stays when the setpoints come back."""
    stop = begin(probe)
    setpoint = here(probe)
    stop()
    probe.run(2.0)
    require(probe.set_mode("hold") == ACCEPTED, "HOLD is refused")
    fly(probe, setpoint, 2.0)
    require(probe.is_in("hold"), "OFFBOARD came back against the operator's choice")


@book.rule(f"{PX4_PAGE}; {OBSERVED}", effect=FLIES, flavours=PX4_ONLY)
def short_gap_is_no_loss(probe: VehicleProbe) -> None:
    """Gaps of 0.3, 0.6 and 0.9 s change nothing; 2 Hz is enough."""
    begin(probe)()
    setpoint = here(probe)
    for gap_s in (0.3, 0.6, 0.9, 0.5, 0.5):
        probe.send(setpoint.message(probe.target))
        mark = probe.mark
        probe.run(gap_s)
        for entry in probe.inbox[mark:]:
            if isinstance(entry.message, mavlink.MAVLink_heartbeat_message):
                lost = entry.source == probe.target and entry.message.custom_mode != 6 << 16
                require(not lost, f"lost in a gap of {gap_s} s")


@book.rule(
    f"{PX4_PAGE}; {OBSERVED} (stricter: a NaN invalidates the whole message)",
    effect=FLIES,
    flavours=PX4_ONLY,
)
def senseless_setpoint_is_no_proof_of_life(probe: VehicleProbe) -> None:
    """A stream of invalid setpoints counts as lost."""
    begin(probe)()
    place = probe.place()
    hold = LocalSetpoint(place)
    for name, build in invalid_setpoints(probe, place).items():
        follow(probe, hold, 1.5)
        stop = probe.stream(build)
        probe.run(2.5)
        is_alive = probe.is_in("offboard")
        stop()
        require(not is_alive, f"{name}: OFFBOARD goes on")


@book.rule(f"{PX4_PAGE} (unknown frame: a text)", effect=FLIES, flavours=PX4_ONLY)
def unknown_frame_is_told(probe: VehicleProbe) -> None:
    """A setpoint in a frame that is not known is answered by a text."""
    begin(probe)()
    setpoint = LocalSetpoint(probe.place(), frame=20)
    mark = probe.mark
    fly(probe, setpoint, 2.0)
    texts = [
        e for e in probe.inbox[mark:] if isinstance(e.message, mavlink.MAVLink_statustext_message)
    ]
    require(bool(texts), "no text")


@book.rule(OBSERVED, effect=FLIES, flavours=PX4_ONLY)
def missing_axis_holds_place(probe: VehicleProbe) -> None:
    """A position with one axis masked off stays in OFFBOARD and in place."""
    begin(probe)()
    before = probe.place()
    far = (before[0] + 30.0, before[1], before[2] - 20.0)
    fly(probe, LocalSetpoint(far, mask=POSITION | 4), 3.0)
    require(probe.is_in("offboard"), "it left OFFBOARD")
    nothing_moved(before, probe.place(), 1.5)
