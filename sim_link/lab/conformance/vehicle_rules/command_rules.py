"""Commands: always acknowledged, never guessed, each flavour with its own results; arming."""

from __future__ import annotations

import itertools
import math

from companion.mav.dialect import Message, mavlink
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
from sim_link.lab.conformance.rules import (
    ASKS,
    CHANGES,
    FLIES,
    PX4_ONLY,
    NotApplicable,
    Role,
    RuleBook,
    require,
)
from sim_link.lab.conformance.vehicle_probe import ACK_S, ARM, FORCE, NAN, PREARM, VehicleProbe

command_book = RuleBook(Role.VEHICLE, "commands")
SERVICE = "MAVLink guide, Command Protocol"
LONG_RUNNING = f"{SERVICE} (long-running commands)"
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
ATTITUDE_ID = mavlink.MAVLINK_MSG_ID_ATTITUDE
SET_MODE = mavlink.MAV_CMD_DO_SET_MODE
GET_INTERVAL = mavlink.MAV_CMD_GET_MESSAGE_INTERVAL
CALIBRATION = mavlink.MAV_CMD_PREFLIGHT_CALIBRATION


@command_book.rule(SERVICE)
def unknown_command_is_unsupported(probe: VehicleProbe) -> None:
    """An unknown command is acknowledged as UNSUPPORTED, LONG and INT."""
    probe.require_result(UNSUPPORTED, UNKNOWN_COMMAND)
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
    acks = probe.heard(Ack, mark)
    require(len(acks) == 1, f"{len(acks)} acknowledgements")


@command_book.rule(f"{SERVICE}; MAVSDK fills unused parameters with NaN")
def unused_parameters_may_be_nan(probe: VehicleProbe) -> None:
    """Parameters that a command does not use may be NaN, or any number."""
    for filler in (NAN, 0.0, -1.0, math.inf, 3e38):
        probe.require_result(ACCEPTED, REQUEST, VERSION_ID, *[filler] * 5, 0.0)


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
    require(bool(probe.heard(Version, mark)), "the message did not come first")


@command_book.rule(MESSAGES)
def unavailable_message_is_refused(probe: VehicleProbe) -> None:
    """REQUEST_MESSAGE of what there is not is refused: DENIED, UNSUPPORTED or FAILED."""
    for number in (9_999.0, 16_777_215.0, NAN, 0.5, -1.0, math.inf, 1e30):
        probe.require_result((DENIED, UNSUPPORTED, FAILED), REQUEST, number)


def require_sent(probe: VehicleProbe, kind: type[Message], number: int, *params: float) -> None:
    """A command must be accepted and send a message."""
    mark = probe.mark
    probe.require_result(ACCEPTED, number, *params)
    probe.expect(kind, mark=mark)


@command_book.rule(
    "MAVLink common, MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES (deprecated, used by MAVSDK)"
)
def legacy_capabilities_request_works(probe: VehicleProbe) -> None:
    """Command 520 sends AUTOPILOT_VERSION."""
    require_sent(probe, Version, mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, 1.0)


@command_book.rule("MAVLink common, MAV_CMD_GET_HOME_POSITION (deprecated)")
def legacy_home_request_works(probe: VehicleProbe) -> None:
    """Command 410 sends HOME_POSITION once there is a home."""
    probe.get_ready()
    require_sent(probe, mavlink.MAVLink_home_position_message, mavlink.MAV_CMD_GET_HOME_POSITION)


# Message intervals


@command_book.rule(INTERVALS + "; MAVLink common, MESSAGE_INTERVAL")
def interval_is_told(probe: VehicleProbe) -> None:
    """MESSAGE_INTERVAL tells what was set, by command 510 and by REQUEST_MESSAGE."""
    try:
        require(probe.set_interval(ATTITUDE_ID, 0.2) == ACCEPTED, "SET_MESSAGE_INTERVAL")
        for ask in ((GET_INTERVAL, float(ATTITUDE_ID)), (REQUEST, 244.0)):
            require(interval_us(probe, *ask) == 200_000, f"asked by {ask[0]}: not 200000 us")
    finally:
        probe.set_interval(ATTITUDE_ID, 0.0)


def interval_us(probe: VehicleProbe, number: int, first: float) -> int:
    """MESSAGE_INTERVAL.interval_us of ATTITUDE, asked by a command."""
    mark, kind = probe.mark, mavlink.MAVLink_message_interval_message
    probe.require_result(ACCEPTED, number, first, float(ATTITUDE_ID))
    return int(probe.expect(kind, lambda m: m.message_id == ATTITUDE_ID, mark=mark).interval_us)


@command_book.rule(INTERVALS + "; MAVLink common, MESSAGE_INTERVAL")
def stopped_stream_has_interval_minus_one(probe: VehicleProbe) -> None:
    """MESSAGE_INTERVAL of a stopped stream is -1."""
    probe.set_interval(ATTITUDE_ID, -1.0)
    told = interval_us(probe, GET_INTERVAL, float(ATTITUDE_ID))
    probe.set_interval(ATTITUDE_ID, 0.0)
    require(told == -1, f"{told} us")


UNAVAILABLE = "MAVLink common, MESSAGE_INTERVAL (0: not available)"


@command_book.rule(UNAVAILABLE, ardupilot="ArduCopter answers FAILED, and 0")
def interval_of_an_unknown_message_is_zero(probe: VehicleProbe) -> None:
    """MESSAGE_INTERVAL of a message that there is not is 0."""
    mark = probe.mark
    probe.command(GET_INTERVAL, 12_345.0)
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
    for params in ((NAN, 1e6), (30.5, 1e6), (30.0, NAN), (30.0, math.inf), (30.0, -5.0)):
        probe.require_result(REFUSALS, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, *params)


@command_book.rule(OBSERVED_PX4, flavours=PX4_ONLY)
def heartbeat_rate_cannot_be_changed(probe: VehicleProbe) -> None:
    """SET_MESSAGE_INTERVAL of HEARTBEAT fails and changes nothing."""
    result = probe.set_interval(0, -1.0)
    require(result == FAILED, f"result {result}")
    probe.heartbeat()


# Frames and modes


@command_book.rule(f"{SERVICE} (UNSUPPORTED_MAV_FRAME; never guess another frame)", effect=CHANGES)
def unsupported_frame_is_told(probe: VehicleProbe) -> None:
    """A place in a frame that a command does not take is UNSUPPORTED_MAV_FRAME."""
    probe.get_ready()
    home = probe.home()
    place = (home.latitude + 900, home.longitude, home.altitude / 1e3)
    for frame in (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_NED, 20):
        result = probe.set_home(place, frame)
        require(result == UNSUPPORTED_FRAME, f"frame {frame}: result {result}")
    require(probe.home().latitude == home.latitude, "home moved")


def require_mode_refused(probe: VehicleProbe, *modes: float) -> None:
    """DO_SET_MODE must be refused for each mode, and nothing changes."""
    before = probe.heartbeat().custom_mode
    for mode in modes:
        probe.require_result(REFUSALS, SET_MODE, 1.0, mode, 0.0)
    require(probe.heartbeat().custom_mode == before, "the mode changed")


@command_book.rule(f"{MODE}; {STRICT}", effect=CHANGES)
def unknown_mode_is_refused(probe: VehicleProbe) -> None:
    """DO_SET_MODE with a mode that there is not is refused, and the mode stays."""
    require_mode_refused(probe, 99.0, 250.0)


@command_book.rule(f"{MODE} {STRICT}", effect=CHANGES)
def senseless_mode_is_refused(probe: VehicleProbe) -> None:
    """DO_SET_MODE with NaN, a fraction or a number beyond a byte is refused."""
    require_mode_refused(probe, NAN, 0.5, 260.0, -1.0, math.inf)


@command_book.rule(f"{MODE}; {OBSERVED_ARDUPILOT}", effect=CHANGES)
def mode_without_custom_flag_is_refused(probe: VehicleProbe) -> None:
    """DO_SET_MODE without CUSTOM_MODE_ENABLED is refused."""
    probe.require_result(REFUSALS, SET_MODE, 0.0, 4.0, 3.0)


@command_book.rule(f"{OBSERVED_PX4}; {OBSERVED_ARDUPILOT}", effect=CHANGES)
def set_mode_message_is_acknowledged(probe: VehicleProbe) -> None:
    """The SET_MODE message works and is answered by a COMMAND_ACK of DO_SET_MODE."""
    number = 4 << 16 | 6 << 24 if probe.is_px4 else 2
    mark = probe.mark
    message = mavlink.MAVLink_set_mode_message(probe.target[0], 1, number)
    ack = probe.ask(message, Ack, lambda m: m.command == SET_MODE)
    require(ack.result == ACCEPTED, f"result {ack.result}")
    probe.expect(mavlink.MAVLink_heartbeat_message, lambda m: m.custom_mode == number, mark=mark)
    probe.set_mode("hold" if probe.is_px4 else "stabilized")


@command_book.rule("MAVLink guide, Routing", effect=CHANGES)
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


def calibrate(probe: VehicleProbe) -> None:
    """Ask for a calibration, which takes its time."""
    params = (1, 0, 0, 0, 0, 0, 0)
    probe.send(mavlink.MAVLink_command_long_message(*probe.target, CALIBRATION, 0, *params))


def is_final(ack: Ack) -> bool:
    """Whether a calibration ended with it."""
    return bool(ack.command == CALIBRATION and ack.result != IN_PROGRESS)


@command_book.rule(LONG_RUNNING, effect=CHANGES)
def long_running_command_reports_and_can_be_cancelled(probe: VehicleProbe) -> None:
    """A long command reports IN_PROGRESS, refuses a second one, and ends when cancelled."""
    mark = probe.mark
    calibrate(probe)
    first = probe.expect(Ack, lambda m: m.command == CALIBRATION, mark=mark, within_s=ACK_S)
    if first.result != IN_PROGRESS:
        raise NotApplicable(f"calibration is answered by {first.result} at once")
    require(first.progress <= 100 or first.progress == 255, f"progress {first.progress}")
    mark = probe.mark
    calibrate(probe)
    second = probe.expect(Ack, is_final, mark=mark)
    require(second.result == TEMPORARILY_REJECTED, f"the same again: result {second.result}")
    mark = probe.mark
    send_cancel(probe, CALIBRATION)
    last = probe.expect(Ack, is_final, mark=mark)
    require(last.result == CANCELLED, f"cancelled: result {last.result}")
    probe.expect_none(Ack, lambda m: m.command == CALIBRATION, what="after the end")


@command_book.rule(LONG_RUNNING, effect=CHANGES)
def long_running_command_ends_with_a_final_result(probe: VehicleProbe) -> None:
    """IN_PROGRESS is repeated until a final result follows."""
    mark = probe.mark
    calibrate(probe)
    probe.expect(Ack, lambda m: m.command == CALIBRATION, mark=mark, within_s=ACK_S)
    final = probe.expect(Ack, is_final, mark=mark, within_s=60.0)
    require(final.result == ACCEPTED, f"result {final.result}")
    reports = probe.times(Ack, mark)[:-1]
    for earlier, later in itertools.pairwise(reports):
        require(later - earlier < 3.0, f"{later - earlier:.1f} s between two reports")


@command_book.rule(SERVICE, effect=CHANGES)
def cancelling_nothing_does_no_harm(probe: VehicleProbe) -> None:
    """COMMAND_CANCEL of what is not running does no harm."""
    send_cancel(probe, CALIBRATION)
    probe.require_hearing()


@command_book.rule("MAVLink common, MAV_CMD_MISSION_START", effect=FLIES)
def mission_start_without_a_mission_is_refused(probe: VehicleProbe) -> None:
    """MISSION_START without a mission is refused."""
    probe.send(mavlink.MAVLink_mission_clear_all_message(*probe.target, 0))
    probe.run(0.5)
    probe.take_off(5.0)
    probe.require_result(REFUSALS, mavlink.MAV_CMD_MISSION_START, 0.0, 0.0)


arming_book = RuleBook(Role.VEHICLE, "arming", FLIES)
BOTH_OBSERVED = f"{OBSERVED_PX4}; {OBSERVED_ARDUPILOT}"
REASON_TEXTS = "FAILED, with the reason as texts"


def refusal_of(probe: VehicleProbe) -> int:
    """The MAV_RESULT by which the flavour refuses to arm or disarm."""
    return TEMPORARILY_REJECTED if probe.is_px4 else FAILED


@arming_book.rule(f"{SERVICE} (commands are idempotent)", effect=ASKS)
def disarming_the_disarmed_is_accepted(probe: VehicleProbe) -> None:
    """Disarming a disarmed vehicle is ACCEPTED."""
    probe.require_disarmed()
    probe.require_result(ACCEPTED, ARM, 0.0, 0.0)


@arming_book.rule(BOTH_OBSERVED, px4="TEMPORARILY_REJECTED", ardupilot=REASON_TEXTS)
def arming_before_ready_is_refused(probe: VehicleProbe) -> None:
    """Right after boot arming is refused, forced or not, and a text says why."""
    probe.set_interval(mavlink.MAVLINK_MSG_ID_SYS_STATUS, 0.1)
    probe.run(0.5)
    status = probe.latest(mavlink.MAVLink_sys_status_message)
    if status.onboard_control_sensors_health & PREARM:
        raise NotApplicable("it is ready already; seen only right after boot")
    mark = probe.mark
    for force in (0.0, FORCE) if probe.is_px4 else (0.0,):
        probe.require_result(refusal_of(probe), ARM, 1.0, force)
    probe.expect(mavlink.MAVLink_statustext_message, mark=mark, what="text with the reason")


@arming_book.rule(f"{SERVICE} {STRICT}")
def senseless_arming_is_refused(probe: VehicleProbe) -> None:
    """Arming with NaN, a fraction or 2 is refused and arms nothing."""
    probe.get_ready()
    for wanted in (NAN, 0.4, 2.0, -1.0, math.inf):
        probe.require_result(REFUSALS, ARM, wanted, 0.0)
    require(not probe.is_armed(), "it is armed")


@arming_book.rule(f"{SERVICE} (commands are idempotent)")
def arming_the_armed_is_accepted(probe: VehicleProbe) -> None:
    """Arming an armed vehicle is ACCEPTED and changes nothing."""
    probe.arm()
    probe.require_result(ACCEPTED, ARM, 1.0, 0.0)
    require(probe.is_armed(), "not armed any more")


@arming_book.rule(BOTH_OBSERVED, px4="TEMPORARILY_REJECTED", ardupilot="FAILED, with a text")
def arming_in_a_mode_that_cannot_is_refused(probe: VehicleProbe) -> None:
    """In LAND and RETURN arming is refused."""
    probe.get_ready()
    for mode in ("land", "return"):
        probe.set_mode(mode)
        probe.require_result(refusal_of(probe), ARM, 1.0, 0.0)


@arming_book.rule(
    f"MAVLink common, MAV_CMD_COMPONENT_ARM_DISARM; {BOTH_OBSERVED}",
    px4="TEMPORARILY_REJECTED",
    ardupilot="FAILED",
)
def disarming_in_the_air_is_refused(probe: VehicleProbe) -> None:
    """In the air disarming is refused unless it is forced."""
    probe.take_off()
    probe.require_result(refusal_of(probe), ARM, 0.0, 0.0)
    require(probe.is_armed(), "it is disarmed")
    probe.require_result(ACCEPTED, ARM, 0.0, FORCE)
    require(not probe.is_armed(), "a forced disarm does nothing")


@arming_book.rule(f"PX4 COM_DISARM_PRFLT (10 s); {OBSERVED_ARDUPILOT}")
def idle_vehicle_disarms(probe: VehicleProbe) -> None:
    """Armed and left on the ground it disarms by itself after about 10 s."""
    probe.arm()
    probe.run(5.0)
    require(probe.is_armed(), "disarmed after 5 s already")
    probe.await_disarmed(9.0)
