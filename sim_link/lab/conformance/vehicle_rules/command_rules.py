"""The command protocol, arming and disarming.

Commands: always acknowledged, never guessed, each flavour with its own results.

Arming and disarming: when it is refused, and what is said then.
"""

from __future__ import annotations

import itertools
import math

from companion.mav.dialect import mavlink
from sim_link.lab.conformance.mavlink_oracle import (
    ACCEPTED,
    CANCELLED,
    DENIED,
    FAILED,
    IN_PROGRESS,
    OBSERVED_ARDUPILOT,
    OBSERVED_PX4,
    REFUSALS,
    TEMPORARILY_REJECTED,
    UNSUPPORTED,
    UNSUPPORTED_FRAME,
    build_raw,
)
from sim_link.lab.conformance.rules import PX4_ONLY, Effect, NotApplicable, Role, RuleBook, require
from sim_link.lab.conformance.vehicle_probe import ACK_S, ARM, FORCE, NAN, PREARM, VehicleProbe

command_book = RuleBook(Role.VEHICLE, "commands")
SERVICE = "MAVLink guide, Command Protocol"
MESSAGES = "MAVLink common, MAV_CMD_REQUEST_MESSAGE"
INTERVALS = "MAVLink common, MAV_CMD_SET_MESSAGE_INTERVAL"
MODE = "MAVLink common, MAV_CMD_DO_SET_MODE"
STRICT = "(stricter than the real one, which accepts it)"
UNKNOWN_COMMAND = 31_999
COMMAND_CANCEL_CRC_EXTRA = 14
REQUEST = mavlink.MAV_CMD_REQUEST_MESSAGE
Ack = mavlink.MAVLink_command_ack_message
Version = mavlink.MAVLink_autopilot_version_message
VERSION_ID = float(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
ATTITUDE_ID = float(mavlink.MAVLINK_MSG_ID_ATTITUDE)
SET_MODE = mavlink.MAV_CMD_DO_SET_MODE


@command_book.rule(SERVICE)
def unknown_command_is_unsupported(probe: VehicleProbe) -> None:
    """An unknown command is acknowledged as UNSUPPORTED, LONG and INT."""
    result = probe.command(UNKNOWN_COMMAND)
    require(result == UNSUPPORTED, f"COMMAND_LONG: result {result}")
    result = probe.command_int(UNKNOWN_COMMAND, mavlink.MAV_FRAME_GLOBAL)
    require(result == UNSUPPORTED, f"COMMAND_INT: result {result}")


@command_book.rule(SERVICE)
def command_int_works_like_long(probe: VehicleProbe) -> None:
    """A command without a place is obeyed as COMMAND_INT, too."""
    mark = probe.mark
    result = probe.command_int(REQUEST, mavlink.MAV_FRAME_GLOBAL, (VERSION_ID, 0.0, 0.0, 0.0))
    require(result == ACCEPTED, f"result {result}")
    probe.expect(Version, mark=mark)


@command_book.rule(SERVICE)
def repeated_command_is_acknowledged_again(probe: VehicleProbe) -> None:
    """A command sent again with confirmation + 1 is acknowledged again."""
    for confirmation in (0, 1, 2):
        result = probe.command(REQUEST, VERSION_ID, confirmation=confirmation)
        require(result == ACCEPTED, f"confirmation {confirmation}: result {result}")


@command_book.rule(SERVICE)
def each_command_gets_one_acknowledgement(probe: VehicleProbe) -> None:
    """A command gets one final COMMAND_ACK, not two."""
    mark = probe.mark
    probe.command(REQUEST, VERSION_ID)
    probe.run(1.0)
    acks = [e for e in probe.inbox[mark:] if isinstance(e.message, Ack)]
    require(len(acks) == 1, f"{len(acks)} acknowledgements")


@command_book.rule(f"{SERVICE}; MAVSDK fills unused parameters with NaN")
def unused_parameters_may_be_nan(probe: VehicleProbe) -> None:
    """Parameters that a command does not use may be NaN, or any number."""
    for filler in (NAN, 0.0, -1.0, math.inf, 3e38):
        result = probe.command(REQUEST, VERSION_ID, *[filler] * 5, 0.0)
        require(result == ACCEPTED, f"filled with {filler}: result {result}")


@command_book.rule(MESSAGES + "; PX4 1.15, observed in SITL (the message first)")
def requested_message_is_sent(probe: VehicleProbe) -> None:
    """REQUEST_MESSAGE sends the message and is ACCEPTED."""
    for kind in (Version, mavlink.MAVLink_heartbeat_message, mavlink.MAVLink_attitude_message):
        probe.request(kind)


@command_book.rule(MESSAGES + "; PX4 1.15, observed in SITL", flavours=PX4_ONLY)
def requested_message_comes_before_its_acknowledgement(probe: VehicleProbe) -> None:
    """The requested message leaves before the COMMAND_ACK."""
    mark = probe.mark
    probe.command(REQUEST, VERSION_ID)
    kinds = [type(e.message) for e in probe.inbox[mark:]]
    require(Version in kinds, "the message did not come first")


@command_book.rule(MESSAGES)
def unavailable_message_is_refused(probe: VehicleProbe) -> None:
    """REQUEST_MESSAGE of what there is not is refused: DENIED, UNSUPPORTED or FAILED."""
    for number in (9_999.0, 16_777_215.0, NAN, 0.5, -1.0, math.inf, 1e30):
        result = probe.command(REQUEST, number)
        require(result in (DENIED, UNSUPPORTED, FAILED), f"message {number}: result {result}")


@command_book.rule(
    "MAVLink common, MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES (deprecated, used by MAVSDK)"
)
def legacy_capabilities_request_works(probe: VehicleProbe) -> None:
    """Command 520 sends AUTOPILOT_VERSION."""
    mark = probe.mark
    result = probe.command(mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, 1.0)
    require(result == ACCEPTED, f"result {result}")
    probe.expect(Version, mark=mark)


@command_book.rule("MAVLink common, MAV_CMD_GET_HOME_POSITION (deprecated)")
def legacy_home_request_works(probe: VehicleProbe) -> None:
    """Command 410 sends HOME_POSITION once there is a home."""
    probe.get_ready()
    mark = probe.mark
    result = probe.command(mavlink.MAV_CMD_GET_HOME_POSITION)
    require(result == ACCEPTED, f"result {result}")
    probe.expect(mavlink.MAVLink_home_position_message, mark=mark)


# Message intervals


@command_book.rule(INTERVALS + "; MAVLink common, MESSAGE_INTERVAL")
def interval_is_told(probe: VehicleProbe) -> None:
    """MESSAGE_INTERVAL tells what was set, by command 510 and by REQUEST_MESSAGE."""
    try:
        require(probe.set_interval(int(ATTITUDE_ID), 0.2) == ACCEPTED, "SET_MESSAGE_INTERVAL")
        for ask in ((mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, ATTITUDE_ID), (REQUEST, 244.0)):
            require(interval_us(probe, *ask) == 200_000, f"asked by {ask[0]}: not 200000 us")
    finally:
        probe.set_interval(int(ATTITUDE_ID), 0.0)


def interval_us(probe: VehicleProbe, number: int, first: float) -> int:
    """MESSAGE_INTERVAL.interval_us of ATTITUDE, asked by a command."""
    mark = probe.mark
    result = probe.command(number, first, ATTITUDE_ID)
    require(result == ACCEPTED, f"command {number}: result {result}")
    answer = probe.expect(
        mavlink.MAVLink_message_interval_message,
        lambda m: m.message_id == int(ATTITUDE_ID),
        mark=mark,
    )
    return int(answer.interval_us)


@command_book.rule(INTERVALS + "; MAVLink common, MESSAGE_INTERVAL")
def stopped_stream_has_interval_minus_one(probe: VehicleProbe) -> None:
    """MESSAGE_INTERVAL of a stopped stream is -1."""
    probe.set_interval(int(ATTITUDE_ID), -1.0)
    told = interval_us(probe, mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, ATTITUDE_ID)
    probe.set_interval(int(ATTITUDE_ID), 0.0)
    require(told == -1, f"{told} us")


@command_book.rule(
    "MAVLink common, MESSAGE_INTERVAL (0: not available)",
    ardupilot="ArduCopter answers FAILED, and 0",
)
def interval_of_an_unknown_message_is_zero(probe: VehicleProbe) -> None:
    """MESSAGE_INTERVAL of a message that there is not is 0."""
    mark = probe.mark
    probe.command(mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, 12_345.0)
    answer = probe.expect(mavlink.MAVLink_message_interval_message, mark=mark)
    require(answer.interval_us == 0, f"{answer.interval_us} us")


@command_book.rule(INTERVALS, ardupilot="DENIED, with a text", px4="FAILED")
def interval_of_an_unknown_message_is_refused(probe: VehicleProbe) -> None:
    """SET_MESSAGE_INTERVAL of a message that there is not is refused."""
    result = probe.set_interval(9_999, 0.1)
    wanted = FAILED if probe.is_px4 else DENIED
    require(result == wanted, f"result {result}, not {wanted}")


@command_book.rule(f"{INTERVALS} {STRICT}")
def senseless_interval_is_refused(probe: VehicleProbe) -> None:
    """SET_MESSAGE_INTERVAL with NaN, infinity or a fraction of a message id is refused."""
    number = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
    for params in ((NAN, 1e6), (30.5, 1e6), (30.0, NAN), (30.0, math.inf), (30.0, -5.0)):
        result = probe.command(number, *params)
        require(result in REFUSALS, f"{params}: result {result}")


@command_book.rule(OBSERVED_PX4, flavours=PX4_ONLY)
def heartbeat_rate_cannot_be_changed(probe: VehicleProbe) -> None:
    """SET_MESSAGE_INTERVAL of HEARTBEAT fails and changes nothing."""
    result = probe.set_interval(0, -1.0)
    require(result == FAILED, f"result {result}")
    probe.heartbeat()


# Frames


@command_book.rule(
    f"{SERVICE} (UNSUPPORTED_MAV_FRAME; never guess another frame)", effect=Effect.CHANGES
)
def unsupported_frame_is_told(probe: VehicleProbe) -> None:
    """A place in a frame that a command does not take is UNSUPPORTED_MAV_FRAME."""
    probe.get_ready()
    home = probe.home()
    place = (home.latitude + 900, home.longitude, home.altitude / 1e3)
    for frame in (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_NED, 20):
        result = probe.command_int(mavlink.MAV_CMD_DO_SET_HOME, frame, (0.0, 0.0, 0.0, 0.0), place)
        require(result == UNSUPPORTED_FRAME, f"frame {frame}: result {result}")
    require(probe.home().latitude == home.latitude, "home moved")


# Modes


@command_book.rule(f"{MODE}; {STRICT}", effect=Effect.CHANGES)
def unknown_mode_is_refused(probe: VehicleProbe) -> None:
    """DO_SET_MODE with a mode that there is not is refused, and the mode stays."""
    before = probe.heartbeat().custom_mode
    for mode in (99.0, 250.0):
        result = probe.command(SET_MODE, 1.0, mode, 0.0)
        require(result in REFUSALS, f"mode {mode}: result {result}")
    require(probe.heartbeat().custom_mode == before, "the mode changed")


@command_book.rule(f"{MODE} {STRICT}", effect=Effect.CHANGES)
def senseless_mode_is_refused(probe: VehicleProbe) -> None:
    """DO_SET_MODE with NaN, a fraction or a number beyond a byte is refused."""
    before = probe.heartbeat().custom_mode
    for mode in (NAN, 0.5, 260.0, -1.0, math.inf):
        result = probe.command(SET_MODE, 1.0, mode, 0.0)
        require(result in REFUSALS, f"mode {mode}: result {result}")
    require(probe.heartbeat().custom_mode == before, "the mode changed")


@command_book.rule(f"{MODE}; {OBSERVED_ARDUPILOT}", effect=Effect.CHANGES)
def mode_without_custom_flag_is_refused(probe: VehicleProbe) -> None:
    """DO_SET_MODE without CUSTOM_MODE_ENABLED is refused."""
    result = probe.command(SET_MODE, 0.0, 4.0, 3.0)
    require(result in REFUSALS, f"result {result}")


@command_book.rule(f"{OBSERVED_PX4}; {OBSERVED_ARDUPILOT}", effect=Effect.CHANGES)
def set_mode_message_is_acknowledged(probe: VehicleProbe) -> None:
    """The SET_MODE message works and is answered by a COMMAND_ACK of DO_SET_MODE."""
    number = 4 << 16 | 6 << 24 if probe.is_px4 else 2
    mark = probe.mark
    probe.send(mavlink.MAVLink_set_mode_message(probe.target[0], 1, number))
    ack = probe.expect(Ack, lambda m: m.command == SET_MODE, mark=mark)
    require(ack.result == ACCEPTED, f"result {ack.result}")
    probe.expect(mavlink.MAVLink_heartbeat_message, lambda m: m.custom_mode == number, mark=mark)
    probe.set_mode("hold" if probe.is_px4 else "stabilized")


@command_book.rule("MAVLink guide, Routing", effect=Effect.CHANGES)
def set_mode_message_for_another_system_is_ignored(probe: VehicleProbe) -> None:
    """A SET_MODE message for another system changes nothing."""
    before = probe.heartbeat().custom_mode
    number = 4 << 16 | 6 << 24 if probe.is_px4 else 9
    probe.send(mavlink.MAVLink_set_mode_message(77, 1, number))
    probe.run(1.0)
    require(probe.heartbeat().custom_mode == before, "the mode changed")
    probe.require_hearing()


# Long-running commands


def send_cancel(probe: VehicleProbe, number: int) -> None:
    """COMMAND_CANCEL (80), which the dialect does not have yet."""
    payload = number.to_bytes(2, "little") + bytes(probe.target)
    probe.send_raw(build_raw(80, payload, COMMAND_CANCEL_CRC_EXTRA, probe.spec()))


@command_book.rule(f"{SERVICE} (long-running commands)", effect=Effect.CHANGES)
def long_running_command_reports_and_can_be_cancelled(probe: VehicleProbe) -> None:
    """A long command reports IN_PROGRESS, refuses a second one, and ends when cancelled."""
    number = mavlink.MAV_CMD_PREFLIGHT_CALIBRATION
    mark = probe.mark
    message = mavlink.MAVLink_command_long_message(*probe.target, number, 0, 1, 0, 0, 0, 0, 0, 0)
    probe.send(message)
    first = probe.expect(Ack, lambda m: m.command == number, mark=mark, within_s=ACK_S)
    if first.result != IN_PROGRESS:
        raise NotApplicable(f"calibration is answered by {first.result} at once")
    require(first.progress <= 100 or first.progress == 255, f"progress {first.progress}")
    mark = probe.mark
    probe.send(message)
    second = probe.expect(Ack, lambda m: m.command == number and m.result != IN_PROGRESS, mark=mark)
    require(second.result == TEMPORARILY_REJECTED, f"the same again: result {second.result}")
    mark = probe.mark
    send_cancel(probe, number)
    last = probe.expect(Ack, lambda m: m.command == number and m.result != IN_PROGRESS, mark=mark)
    require(last.result == CANCELLED, f"cancelled: result {last.result}")
    probe.expect_none(Ack, lambda m: m.command == number, what="after the end")


@command_book.rule(f"{SERVICE} (long-running commands)", effect=Effect.CHANGES)
def long_running_command_ends_with_a_final_result(probe: VehicleProbe) -> None:
    """IN_PROGRESS is repeated until a final result follows."""
    number = mavlink.MAV_CMD_PREFLIGHT_CALIBRATION
    mark = probe.mark
    probe.send(mavlink.MAVLink_command_long_message(*probe.target, number, 0, 1, 0, 0, 0, 0, 0, 0))
    probe.expect(Ack, lambda m: m.command == number, mark=mark, within_s=ACK_S)
    final = probe.expect(
        Ack,
        lambda m: m.command == number and m.result != IN_PROGRESS,
        mark=mark,
        within_s=60.0,
    )
    require(final.result == ACCEPTED, f"result {final.result}")
    reports = [
        e.time_s
        for e in probe.inbox[mark:]
        if isinstance(e.message, Ack) and e.message.result == IN_PROGRESS
    ]
    for earlier, later in itertools.pairwise(reports):
        require(later - earlier < 3.0, f"{later - earlier:.1f} s between two reports")


@command_book.rule(f"{SERVICE}", effect=Effect.CHANGES)
def cancelling_nothing_does_no_harm(probe: VehicleProbe) -> None:
    """COMMAND_CANCEL of what is not running does no harm."""
    send_cancel(probe, mavlink.MAV_CMD_PREFLIGHT_CALIBRATION)
    probe.require_hearing()


@command_book.rule("MAVLink common, MAV_CMD_MISSION_START", effect=Effect.FLIES)
def mission_start_without_a_mission_is_refused(probe: VehicleProbe) -> None:
    """MISSION_START without a mission is refused."""
    probe.send(mavlink.MAVLink_mission_clear_all_message(*probe.target, 0))
    probe.run(0.5)
    probe.take_off(5.0)
    result = probe.command(mavlink.MAV_CMD_MISSION_START, 0.0, 0.0)
    require(result in REFUSALS, f"result {result}")


arming_book = RuleBook(Role.VEHICLE, "arming")


@arming_book.rule(f"{SERVICE} (commands are idempotent)")
def disarming_the_disarmed_is_accepted(probe: VehicleProbe) -> None:
    """Disarming a disarmed vehicle is ACCEPTED."""
    if probe.is_armed():
        raise NotApplicable("the vehicle is armed")
    require(probe.command(ARM, 0.0, 0.0) == ACCEPTED, "refused")


@arming_book.rule(
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


@arming_book.rule(f"{SERVICE} {STRICT}", effect=Effect.FLIES)
def senseless_arming_is_refused(probe: VehicleProbe) -> None:
    """Arming with NaN, a fraction or 2 is refused and arms nothing."""
    probe.get_ready()
    for wanted in (NAN, 0.4, 2.0, -1.0, math.inf):
        result = probe.command(ARM, wanted, 0.0)
        require(result in REFUSALS, f"param1 {wanted}: result {result}")
    require(not probe.is_armed(), "it is armed")


@arming_book.rule(f"{SERVICE} (commands are idempotent)", effect=Effect.FLIES)
def arming_the_armed_is_accepted(probe: VehicleProbe) -> None:
    """Arming an armed vehicle is ACCEPTED and changes nothing."""
    probe.arm()
    require(probe.command(ARM, 1.0, 0.0) == ACCEPTED, "refused")
    require(probe.is_armed(), "not armed any more")


@arming_book.rule(
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


@arming_book.rule(
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


@arming_book.rule(f"PX4 COM_DISARM_PRFLT (10 s); {OBSERVED_ARDUPILOT}", effect=Effect.FLIES)
def idle_vehicle_disarms(probe: VehicleProbe) -> None:
    """Armed and left on the ground it disarms by itself after about 10 s."""
    probe.arm()
    probe.run(5.0)
    require(probe.is_armed(), "disarmed after 5 s already")
    probe.await_disarmed(9.0)
