"""Commands: always acknowledged, never guessed, each flavour with its own results; arming."""

from __future__ import annotations

import itertools
import math
from collections import Counter

from companion.mav.dialect import mavlink
from sim_link.lab.conformance import mavlink_oracle as mav
from sim_link.lab.conformance.rules import ASKS, CHANGES, FLIES, PX4, RuleBook, assume, require
from sim_link.lab.conformance.vehicle_probe import (
    ACK_S,
    GET_INTERVAL,
    Interval,
    VehicleProbe,
    is_ready,
)

SERVICE = "MAVLink guide, Command Protocol"
LONG_RUNNING = f"{SERVICE} (long-running commands)"
MESSAGES = "MAVLink common, MAV_CMD_REQUEST_MESSAGE"
INTERVALS = "MAVLink common, MAV_CMD_SET_MESSAGE_INTERVAL"
INTERVAL_REPORTED = f"{INTERVALS}; MAVLink common, MESSAGE_INTERVAL"
MODE = "MAVLink common, MAV_CMD_DO_SET_MODE"
STRICT = "(stricter than real autopilots, which accept it)"
IDEMPOTENT = f"{SERVICE} (commands are idempotent)"
UNKNOWN_COMMAND = 31_999
COMMAND_CANCEL_CRC_EXTRA = 14
VERSION_ID = float(mav.Version.id)
ATTITUDE_ID = float(mav.Attitude.id)
SET_MODE = mavlink.MAV_CMD_DO_SET_MODE
SET_INTERVAL = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
CALIBRATION = mavlink.MAV_CMD_PREFLIGHT_CALIBRATION
SetMode = mavlink.MAVLink_set_mode_message


class CommandRules(VehicleProbe):
    """Commands on the ground, and the messages they request."""

    book = RuleBook("commands")

    @book.rule(SERVICE)
    def unknown_command_is_unsupported(self) -> None:
        """An unknown COMMAND_LONG or COMMAND_INT is acknowledged as UNSUPPORTED."""
        self.require_result(mav.UNSUPPORTED, UNKNOWN_COMMAND)
        result = self.command_int(UNKNOWN_COMMAND, mavlink.MAV_FRAME_GLOBAL)
        require(result == mav.UNSUPPORTED, f"COMMAND_INT: result {result}")

    @book.rule(SERVICE)
    def command_int_works_like_long(self) -> None:
        """A command without a position is obeyed as COMMAND_INT, too."""
        params = (VERSION_ID, 0.0, 0.0, 0.0)
        result = self.command_int(mav.REQUEST, mavlink.MAV_FRAME_GLOBAL, params)
        require(result == mav.ACCEPTED, f"result {result}")
        self.expect(mav.Version, mark=self.asked)

    @book.rule(SERVICE)
    def repeated_command_is_acknowledged_again(self) -> None:
        """A command sent again with confirmation + 1 is acknowledged again."""
        for confirmation in (0, 1, 2):
            result = self.command(mav.REQUEST, VERSION_ID, confirmation=confirmation)
            require(result == mav.ACCEPTED, f"confirmation {confirmation}: result {result}")

    @book.rule(SERVICE)
    def each_command_gets_one_acknowledgement(self) -> None:
        """A command gets one final COMMAND_ACK, not two."""
        self.command(mav.REQUEST, VERSION_ID)
        self.run(1.0)
        acks = self.heard(mav.Ack, self.asked)
        require(len(acks) == 1, f"{len(acks)} acknowledgements")

    @book.rule(f"{SERVICE}; MAVSDK fills unused parameters with NaN")
    def unused_parameters_may_be_nan(self) -> None:
        """Parameters that a command does not use may be NaN, or any number."""
        self._fill_unused(mav.NAN, 0.0, -1.0)

    @book.rule(f"{SERVICE}; ArduPilot's SITL ends at an overflow (SIM_FLOAT_EXCEPT)", harms=True)
    def unused_parameters_may_be_beyond_all_integers(self) -> None:
        """Parameters that a command does not use may be infinite, or larger than any integer."""
        self._fill_unused(math.inf, 3e38)

    def _fill_unused(self, *fillers: float) -> None:
        for filler in fillers:
            self.require_result(mav.ACCEPTED, mav.REQUEST, VERSION_ID, *[filler] * 5, 0.0)

    @book.rule(f"{MESSAGES}; {mav.OBSERVED_PX4} (the message first)")
    def requested_message_is_sent(self) -> None:
        """REQUEST_MESSAGE sends the message and is ACCEPTED."""
        for kind in (mav.Version, mav.Heartbeat, mav.Attitude):
            self.request(kind)

    @book.rule(f"{MESSAGES}; {mav.OBSERVED_PX4}", flavours=PX4)
    def requested_message_comes_before_its_acknowledgement(self) -> None:
        """The requested message leaves before the COMMAND_ACK."""
        self.command(mav.REQUEST, VERSION_ID)
        require(bool(self.heard(mav.Version, self.asked)), "the message did not come first")

    @book.rule(MESSAGES)
    def unavailable_message_is_refused(self) -> None:
        """REQUEST_MESSAGE of an unknown message is refused: DENIED, UNSUPPORTED or FAILED."""
        self._require_unavailable(9_999.0, 16_777_215.0)

    @book.rule(MESSAGES, harms=True)
    def senseless_message_id_is_refused(self) -> None:
        """REQUEST_MESSAGE of NaN, a fraction or a number beyond all ids is refused."""
        self._require_unavailable(mav.NAN, 0.5, -1.0, math.inf, 1e30)

    def _require_unavailable(self, *numbers: float) -> None:
        for number in numbers:
            self.require_result((mav.DENIED, mav.UNSUPPORTED, mav.FAILED), mav.REQUEST, number)

    @book.rule(
        "MAVLink common, MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES (deprecated, used by MAVSDK)"
    )
    def legacy_capabilities_request_works(self) -> None:
        """Command 520 sends AUTOPILOT_VERSION."""
        self.require_sent(mav.Version, mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, 1.0)

    @book.rule("MAVLink common, MAV_CMD_GET_HOME_POSITION (deprecated)")
    def legacy_home_request_works(self) -> None:
        """Command 410 sends HOME_POSITION once there is a home."""
        self.get_ready()
        self.require_sent(mav.HomePosition, mavlink.MAV_CMD_GET_HOME_POSITION)

    def _interval_us(self, number: int, first: float) -> int:
        """Return MESSAGE_INTERVAL.interval_us of ATTITUDE, asked by a command."""
        self.require_result(mav.ACCEPTED, number, first, ATTITUDE_ID)
        reported = self.expect(Interval, lambda m: m.message_id == ATTITUDE_ID, mark=self.asked)
        return int(reported.interval_us)

    @book.rule(INTERVAL_REPORTED)
    def interval_is_reported(self) -> None:
        """MESSAGE_INTERVAL reports the interval set, by command 510 and by REQUEST_MESSAGE."""
        result = self.set_interval(mav.Attitude, 0.2)
        require(result == mav.ACCEPTED, "SET_MESSAGE_INTERVAL")
        for number, first in ((GET_INTERVAL, ATTITUDE_ID), (mav.REQUEST, 244.0)):
            interval_us = self._interval_us(number, first)
            require(interval_us == 200_000, f"asked by {number}: not 200000 us")

    @book.rule(INTERVAL_REPORTED)
    def stopped_stream_has_interval_minus_one(self) -> None:
        """MESSAGE_INTERVAL of a stopped stream is -1."""
        self.set_interval(mav.Attitude, -1.0)
        interval_us = self._interval_us(GET_INTERVAL, ATTITUDE_ID)
        require(interval_us == -1, f"{interval_us} us")

    @book.rule("MAVLink common, MESSAGE_INTERVAL (0: not available)")
    def interval_of_an_unknown_message_is_zero(self) -> None:
        """MESSAGE_INTERVAL of a message that does not exist is 0."""
        self.command(GET_INTERVAL, 12_345.0)
        interval_us = self.expect(Interval, mark=self.asked).interval_us
        require(interval_us == 0, f"{interval_us} us")

    @book.rule(INTERVALS)
    def interval_of_an_unknown_message_is_refused(self) -> None:
        """SET_MESSAGE_INTERVAL of a message that does not exist is refused."""
        result = self.set_interval(9_999, 0.1)
        wanted = mav.FAILED if self.is_px4 else mav.DENIED
        require(result == wanted, f"result {result}, not {wanted}")

    @book.rule(f"{INTERVALS} {STRICT}", harms=True)
    def senseless_interval_is_refused(self) -> None:
        """SET_MESSAGE_INTERVAL with NaN, infinity or a fraction of a message id is refused."""
        self.require_result(mav.REFUSALS, SET_INTERVAL, mav.NAN, 1e6)
        self.require_result(mav.REFUSALS, SET_INTERVAL, 30.5, 1e6)
        for interval_us in (mav.NAN, math.inf, -5.0):
            self.require_result(mav.REFUSALS, SET_INTERVAL, 30.0, interval_us)

    @book.rule(mav.OBSERVED_PX4, flavours=PX4)
    def heartbeat_rate_cannot_be_changed(self) -> None:
        """SET_MESSAGE_INTERVAL of HEARTBEAT fails and changes nothing."""
        result = self.set_interval(mav.Heartbeat, -1.0)
        require(result == mav.FAILED, f"result {result}")
        self.heartbeat()

    @book.rule(f"{SERVICE} (UNSUPPORTED_MAV_FRAME; never guess another frame)", effect=CHANGES)
    def unsupported_frame_is_refused(self) -> None:
        """A position in a frame that a command does not accept is UNSUPPORTED_MAV_FRAME."""
        self.get_ready()
        home = self.home()
        position = (home.latitude + 900, home.longitude, home.altitude / 1e3)
        for frame in (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_NED, 20):
            result = self.set_home(position, frame)
            require(result == mav.UNSUPPORTED_FRAME, f"frame {frame}: result {result}")
        require(self.home().latitude == home.latitude, "home moved")

    def _require_mode_refused(self, *modes: float) -> None:
        """DO_SET_MODE must be refused for each mode, and nothing changes."""
        before = self.heartbeat().custom_mode
        for mode in modes:
            self.require_result(mav.REFUSALS, SET_MODE, 1.0, mode, 0.0)
        require(self.heartbeat().custom_mode == before, "the mode changed")

    @book.rule(f"{MODE}; {STRICT}", effect=CHANGES)
    def unknown_mode_is_refused(self) -> None:
        """DO_SET_MODE with a mode that does not exist is refused, and the mode stays."""
        self._require_mode_refused(99.0, 250.0)

    @book.rule(f"{MODE} {STRICT}", effect=CHANGES, harms=True)
    def senseless_mode_is_refused(self) -> None:
        """DO_SET_MODE with NaN, a fraction or a number beyond a byte is refused."""
        self._require_mode_refused(mav.NAN, 0.5, 260.0, -1.0, math.inf)

    @book.rule(f"{MODE}; {mav.OBSERVED_ARDUPILOT}", effect=CHANGES)
    def mode_without_custom_flag_is_refused(self) -> None:
        """DO_SET_MODE without CUSTOM_MODE_ENABLED is refused."""
        self.require_result(mav.REFUSALS, SET_MODE, 0.0, 4.0, 3.0)

    @book.rule(mav.OBSERVED_BOTH, effect=CHANGES)
    def set_mode_message_is_acknowledged(self) -> None:
        """The SET_MODE message works and is answered by a COMMAND_ACK."""
        number = 4 << 16 | 6 << 24 if self.is_px4 else 2
        message = SetMode(self.target[0], 1, number)
        answered = SET_MODE if self.is_px4 else SetMode.id
        ack = self.ask(message, mav.Ack, lambda m: m.command == answered)
        require(ack.result == mav.ACCEPTED, f"result {ack.result}")
        self.expect(mav.Heartbeat, lambda m: m.custom_mode == number, mark=self.asked)
        self.set_mode("hold" if self.is_px4 else "stabilized")

    @book.rule("MAVLink guide, Routing", effect=CHANGES)
    def set_mode_message_for_another_system_is_ignored(self) -> None:
        """A SET_MODE message for another system changes nothing."""
        before = self.heartbeat().custom_mode
        self.send(SetMode(77, 1, 4 << 16 | 6 << 24 if self.is_px4 else 9))
        self.run(1.0)
        require(self.heartbeat().custom_mode == before, "the mode changed")
        self.require_hearing()

    def _calibrate(self) -> mav.Ack:
        """Request a calibration, which takes time; return the first answer."""
        message = mav.CommandLong(*self.target, CALIBRATION, 0, 1, *[0] * 6)
        return self.ask(message, mav.Ack, lambda m: m.command == CALIBRATION, within_s=ACK_S)

    def _await_end(self, within_s: float = 2.0) -> int:

        def is_end(ack: mav.Ack) -> bool:
            return bool(ack.command == CALIBRATION and ack.result != mav.IN_PROGRESS)

        return int(self.expect(mav.Ack, is_end, mark=self.asked, within_s=within_s).result)

    def _cancel(self) -> None:
        """COMMAND_CANCEL (80) of a calibration, which the dialect does not have yet."""
        payload = CALIBRATION.to_bytes(2, "little") + bytes(self.target)
        self.send_raw(mav.build_raw(80, payload, COMMAND_CANCEL_CRC_EXTRA, self.spec()))

    @book.rule(LONG_RUNNING, effect=CHANGES, harms=True)
    def long_running_command_reports_and_can_be_cancelled(self) -> None:
        """A long command reports IN_PROGRESS, refuses a second one, and ends when cancelled."""
        first = self._calibrate()
        is_long = first.result == mav.IN_PROGRESS
        assume(is_long, f"calibration is answered by {first.result} at once")
        require(first.progress <= 100 or first.progress == 255, f"progress {first.progress}")
        self._calibrate()
        second = self._await_end()
        require(second == mav.TEMPORARILY_REJECTED, f"the same again: result {second}")
        self._cancel()
        last = self._await_end()
        require(last == mav.CANCELLED, f"cancelled: result {last}")
        self.expect_none(mav.Ack, lambda m: m.command == CALIBRATION, what="after the end")

    @book.rule(LONG_RUNNING, effect=CHANGES, harms=True)
    def long_running_command_ends_with_a_final_result(self) -> None:
        """IN_PROGRESS is repeated until a final result follows."""
        self._calibrate()
        final = self._await_end(60.0)
        require(final == mav.ACCEPTED, f"result {final}")
        reports = self.times(mav.Ack, self.asked)[:-1]
        for earlier, later in itertools.pairwise(reports):
            require(later - earlier < 3.0, f"{later - earlier:.1f} s between two reports")

    @book.rule(SERVICE, effect=CHANGES)
    def cancelling_nothing_does_no_harm(self) -> None:
        """COMMAND_CANCEL of a command that is not running has no effect."""
        self._cancel()
        self.require_hearing()

    @book.rule("MAVLink common, MAV_CMD_MISSION_START", effect=FLIES)
    def mission_start_without_a_mission_is_refused(self) -> None:
        """MISSION_START without a mission is refused."""
        self.send(mav.Clear(*self.target, mav.MISSION))
        self.run(0.5)
        self.take_off(5.0)
        self.require_result(mav.REFUSALS, mavlink.MAV_CMD_MISSION_START, 0.0, 0.0)


class ArmingRules(VehicleProbe):
    """Arming and disarming."""

    book = RuleBook("arming", FLIES)

    @property
    def _refusal(self) -> int:
        """The MAV_RESULT by which the flavour refuses to arm or disarm."""
        return mav.TEMPORARILY_REJECTED if self.is_px4 else mav.FAILED

    @book.rule(IDEMPOTENT, effect=ASKS)
    def disarming_the_disarmed_is_accepted(self) -> None:
        """Disarming a disarmed vehicle is ACCEPTED."""
        self.require_disarmed()
        self.require_result(mav.ACCEPTED, mav.ARM, 0.0, 0.0)

    @book.rule(mav.OBSERVED_BOTH)
    def arming_before_ready_is_refused(self) -> None:
        """Right after boot arming is refused, forced or not, and a text gives the reason."""
        self.set_interval(mav.SysStatus, 0.1)
        self.run(0.5)
        is_booting = not is_ready(self.latest(mav.SysStatus))
        assume(is_booting, "it is ready already; seen only right after boot")
        mark = self.mark
        for force in (0.0, mav.FORCE_DISARM) if self.is_px4 else (0.0,):
            self.require_result(self._refusal, mav.ARM, 1.0, force)
        self.expect(mav.StatusText, mark=mark, what="text with the reason")

    @book.rule(f"{SERVICE} {STRICT}", harms=True)
    def senseless_arming_is_refused(self) -> None:
        """Arming with NaN, a fraction or 2 is refused and arms nothing."""
        self.get_ready()
        for wanted in (mav.NAN, 0.4, 2.0, -1.0, math.inf):
            self.require_result(mav.REFUSALS, mav.ARM, wanted, 0.0)
        require(not self.is_armed(), "it is armed")

    @book.rule(IDEMPOTENT)
    def arming_the_armed_is_accepted(self) -> None:
        """Arming an armed vehicle is ACCEPTED and changes nothing."""
        self.arm()
        self.require_result(mav.ACCEPTED, mav.ARM, 1.0, 0.0)
        require(self.is_armed(), "not armed any more")

    @book.rule(mav.OBSERVED_BOTH)
    def arming_in_a_mode_that_cannot_is_refused(self) -> None:
        """In LAND and RETURN arming is refused."""
        self.get_ready()
        for mode in ("land", "return"):
            self.set_mode(mode)
            self.require_result(self._refusal, mav.ARM, 1.0, 0.0)

    @book.rule(f"MAVLink common, MAV_CMD_COMPONENT_ARM_DISARM; {mav.OBSERVED_BOTH}")
    def disarming_in_the_air_is_refused(self) -> None:
        """Disarming is refused in the air."""
        self.take_off()
        self.require_result(self._refusal, mav.ARM, 0.0, 0.0)
        require(self.is_armed(), "it is disarmed")

    @book.rule("MAVLink common, MAV_CMD_COMPONENT_ARM_DISARM (21196)", harms=True)
    def forced_disarming_in_the_air_is_obeyed(self) -> None:
        """In the air disarming is obeyed when it is forced."""
        self.take_off()
        self.require_result(mav.ACCEPTED, mav.ARM, 0.0, mav.FORCE_DISARM)
        require(not self.is_armed(), "a forced disarm does nothing")

    @book.rule(f"PX4 COM_DISARM_PRFLT (10 s); {mav.OBSERVED_ARDUPILOT}")
    def idle_vehicle_disarms(self) -> None:
        """Armed and left on the ground it disarms by itself after about 10 s."""
        self.arm()
        self.run(5.0)
        require(self.is_armed(), "disarmed after 5 s already")
        self.await_disarmed(9.0)

    @book.rule("MAVLink common, STATUSTEXT (chunks)")
    def texts_are_well_formed(self) -> None:
        """A text is one message with id 0, or chunks 0, 1, ... of one id that end short."""
        self.command(mav.ARM, 1.0, 0.0)
        self.set_mode("land")
        self.command(mav.ARM, 1.0, 0.0)
        self.run(2.0)
        texts = self.from_vehicle(mav.StatusText)
        assume(bool(texts), "it says nothing")
        chunks: Counter[int] = Counter()
        for text in texts:
            require(text.severity <= 7, f"severity {text.severity}")
            if text.id == 0:
                require(text.chunk_seq == 0, f"chunk {text.chunk_seq} of a single text")
                continue
            due = chunks[text.id]
            require(text.chunk_seq == due, f"chunk {text.chunk_seq} where {due} was due")
            chunks[text.id] += 1
