"""Rules for a companion: identity, commands, and the setpoint stream around and in control."""

from __future__ import annotations

import itertools
import math
from collections import Counter

from companion.mav.dialect import Message, mavlink
from sim_link.lab.conformance import mavlink_oracle as mav
from sim_link.lab.conformance.mavlink_oracle import METRES_PER_E7, LocalTarget
from sim_link.lab.conformance.puppet import (
    ORIGIN_E7_MM,
    SETPOINTS,
    CommandMessage,
    CompanionProbe,
    SetpointMessage,
    accept,
    position_of,
    stay_silent,
)
from sim_link.lab.conformance.rules import PX4, Flavour, RuleBook, assume, require
from sim_link.lab.conformance.station import brief, heartbeat

HEARTBEAT_SERVICE = "MAVLink guide, Heartbeat/Connection Protocol"
IDS = "MAVLink guide, MAVLink IDs"
SERIALIZATION = "MAVLink guide, Packet Serialization"
PING = "MAVLink guide, Ping Protocol"
HEARTBEATS_S = 6.0


class IdentityRules(CompanionProbe):
    """Identity of a companion, and the senders that it obeys."""

    book = RuleBook("identity")

    def _newest(self) -> mav.Heartbeat:
        none = mavlink.MAV_AUTOPILOT_INVALID
        return self.expect(mav.Heartbeat, lambda m: m.autopilot == none, within_s=3.0)

    @book.rule(IDS)
    def shares_the_vehicles_system(self) -> None:
        """The companion has the system id of its vehicle."""
        require(self.companion[0] == self.system_id, f"system {self.companion[0]}")

    @book.rule(IDS)
    def is_an_onboard_computer(self) -> None:
        """Its component id is one of an onboard computer, 191 to 194."""
        require(191 <= self.companion[1] <= 194, f"component {self.companion[1]}")

    @book.rule(HEARTBEAT_SERVICE)
    def reports_an_onboard_controller(self) -> None:
        """HEARTBEAT reports ONBOARD_CONTROLLER, no autopilot, no mode, ACTIVE and version 3."""
        m = self._newest()
        mode = (m.base_mode, m.custom_mode)
        fields = (m.type, m.autopilot, *mode, m.system_status, m.mavlink_version)
        kind, none = mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID
        require(fields == (kind, none, 0, 0, mav.ACTIVE, 3), brief(m))

    @book.rule(HEARTBEAT_SERVICE)
    def says_so_once_a_second(self) -> None:
        """HEARTBEAT is sent once a second."""
        mark = self.mark
        self.run(HEARTBEATS_S)
        times = self.times(mav.Heartbeat, mark)
        require(len(times) >= HEARTBEATS_S - 1, f"{len(times)} in {HEARTBEATS_S:g} s")
        for earlier, later in itertools.pairwise(times):
            require(0.7 < later - earlier < 1.4, f"{later - earlier:.2f} s between two")

    @book.rule("MAVSDK mavsdk_impl.cpp (255/190 is the ground station)")
    def is_no_ground_station(self) -> None:
        """It is not at a ground station's address."""
        require(self.companion != (255, 190), "it is 255/190")

    @book.rule(SERIALIZATION)
    def sends_mavlink2_with_right_crc(self) -> None:
        """Everything it sends is MAVLink 2, passes its CRC and has its trailing zeros cut."""
        self.run(2.0)
        broken = self.reader.counters.bad_crc
        require(broken == 0, f"{broken} broken frames")
        for entry in self.inbox:
            payload, name = entry.payload, entry.message.get_type()
            require(entry.frame[0] == mav.MAGIC_V2, f"{name} in MAVLink 1")
            require(len(payload) == 1 or payload[-1] != 0, f"{name} is not cut")

    @book.rule("MAVLink guide, Packet Loss")
    def sequence_counts_every_message(self) -> None:
        """The sequence number goes up by one with each message."""
        self.run(2.0)
        counts = [e.message.get_seq() for e in self.inbox if e.source == self.companion]
        for first, second in itertools.pairwise(counts):
            require(second == (first + 1) % 256, f"sequence {first} is followed by {second}")

    @book.rule(SERIALIZATION)
    def garbage_does_no_harm(self) -> None:
        """Garbage, broken frames and unknown flags do not stop it."""
        message = heartbeat(mavlink.MAV_TYPE_GCS)
        good = mav.build_frame(message, self.spec())
        unknown = mav.build_frame(message, self.spec(incompat=4))
        for data in (b"\x00" * 50, good[:9], good[:-1] + b"\x00", unknown):
            self.send_raw(data)
        self._newest()

    @book.rule(f"{IDS} (latch the first autopilot)")
    def second_autopilot_is_ignored(self) -> None:
        """Another system's autopilot does not make it change its system id."""
        foreign = mav.Heartbeat(2, 12, 1, 0x60000, 4, 3)
        for _ in range(3):
            self.send_as(foreign, 7, 1)
            self.run(1.0)
        require(self._newest().get_srcSystem() == self.system_id, "it changed its system")

    @book.rule(HEARTBEAT_SERVICE)
    def heartbeat_goes_on_without_the_vehicle(self) -> None:
        """While the vehicle is silent, the companion's HEARTBEAT continues."""
        self.go_silent()
        self.run(4.0)
        self._newest()
        self.come_back()

    @book.rule(PING)
    def ping_response_is_never_answered(self) -> None:
        """A PING with a target is a response, and is not answered."""
        response = mav.Ping(1, 4_712, *self.companion)
        self.require_no_answer([response], mav.Ping, lambda m: m.seq == 4_712)

    @book.rule(PING)
    def ping_request_is_answered_rightly(self) -> None:
        """An answer to a PING to 0/0 goes to its sender, with its time and sequence."""
        mark = self.mark
        self.send(mav.Ping(123_456, 4_711, 0, 0))
        self.run(1.0)
        answers = self.heard(mav.Ping, mark)
        assume(bool(answers), "it does not answer PING, which is optional")
        m = answers[0]
        fields = (m.time_usec, m.seq, m.target_system, m.target_component)
        require(fields == (123_456, 4_711, self.system_id, 1), brief(m))

    @book.rule("MAVLink guide, Time Synchronization")
    def timesync_response_is_never_answered(self) -> None:
        """TIMESYNC with tc1 is a response, and is not answered."""
        self.require_no_answer([mav.Timesync(55, 66)], mav.Timesync, lambda m: m.ts1 == 66)

    @book.rule("MAVLink guide, Message Signing; MAVLink guide, Routing")
    def signing_setup_is_not_passed_on(self) -> None:
        """SETUP_SIGNING, which holds a key, is neither echoed nor passed on."""
        key = bytes(range(1, 33))
        mark = len(self.datagrams)
        self.send(mavlink.MAVLink_setup_signing_message(*self.companion, list(key), 0))
        self.run(1.0)
        require(not any(key in data for data in self.datagrams[mark:]), "the key came back")


COMMAND_SERVICE = "MAVLink guide, Command Protocol"
ROUTING = "MAVLink guide, Routing"
ASKS_FOR_STREAMS = (
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
    mavlink.MAV_CMD_REQUEST_MESSAGE,
    mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES,
)
MAX_COMMANDS_HZ = 25.0
MAX_REPEATS = 10


class RequestRules(CompanionProbe):
    """The commands that a companion answers and sends."""

    book = RuleBook("requests")

    def _stream_requests(self, mark: int = 0) -> list[CommandMessage]:
        return [c for c in self.commands(mark) if c.command in ASKS_FOR_STREAMS]

    @book.rule(COMMAND_SERVICE)
    def unknown_command_is_unsupported(self) -> None:
        """A command for this very component that it does not know is acknowledged UNSUPPORTED."""
        result = self.ask_companion(self.companion)
        require(result is not None, "not acknowledged")
        require(result == mav.UNSUPPORTED, f"result {result}")

    def _require_ignored(self, *targets: tuple[int, int]) -> None:
        for target in targets:
            result = self.ask_companion(target)
            require(result is None, f"{target[0]}/{target[1]}: result {result}")

    @book.rule(ROUTING)
    def command_for_another_component_is_ignored(self) -> None:
        """A command for another component of the system is not acknowledged."""
        self._require_ignored(*((self.system_id, component) for component in (1, 100, 158)))

    @book.rule(ROUTING)
    def command_for_another_system_is_ignored(self) -> None:
        """A command for another system is not acknowledged."""
        self._require_ignored((77, self.companion[1]))

    @book.rule("MAVLink common, MAV_CMD_SET_MESSAGE_INTERVAL (ArduPilot sends nothing unasked)")
    def asks_for_its_streams(self) -> None:
        """It requests the streams that it needs from the autopilot."""
        self.run(3.0)
        streams = self.heard(mavlink.MAVLink_request_data_stream_message)
        require(bool(self._stream_requests()) or bool(streams), "nothing was requested")

    @book.rule(ROUTING)
    def commands_name_the_vehicle(self) -> None:
        """Its commands are addressed to the autopilot, system and component."""
        self.run(3.0)
        self.require_addressed(self.commands())

    @book.rule(COMMAND_SERVICE)
    def requests_are_paced(self) -> None:
        """It does not flood the autopilot with commands, answered or not."""
        self.policy = stay_silent
        mark = self.mark
        self.run(5.0)
        rate_hz = len(self.commands(mark)) / 5.0
        require(rate_hz < MAX_COMMANDS_HZ, f"{rate_hz:.0f} commands a second")

    @book.rule(f"{COMMAND_SERVICE} (retries)")
    def unanswered_command_is_repeated_a_few_times(self) -> None:
        """A command without an answer is repeated with a rising confirmation, and given up."""
        mark = 0 if self.policy is stay_silent else self.mark
        self.policy = stay_silent
        self.run(12.0)
        sent = Counter(
            (c.command, c.confirmation)
            for c in self.commands(mark)
            if isinstance(c, mav.CommandLong) and c.command not in ASKS_FOR_STREAMS
        )
        assume(bool(sent), "it commands nothing but streams meanwhile")
        for number, confirmation in sent:
            is_next = confirmation == 0 or (number, confirmation - 1) in sent
            require(is_next, f"{number}: jumps a confirmation")
            require(confirmation < MAX_REPEATS, f"{number}: repeated {confirmation} times")
        for number in {number for number, _ in sent}:
            require((number, 1) in sent, f"command {number} is not repeated")

    @book.rule(COMMAND_SERVICE)
    def acknowledgement_of_another_system_is_ignored(self) -> None:
        """A COMMAND_ACK from a foreign system is not taken for the vehicle's."""
        self.policy = self._accept_as_another_system
        mark = self.mark
        self.run(4.0)
        self.policy = accept
        assume(bool(self._stream_requests(mark)), "nothing was asked meanwhile")
        self.run(2.0)
        require(self.companion[0] == self.system_id, "it changed its system")

    def _accept_as_another_system(self, command: CommandMessage) -> int | None:
        """Answer with an acknowledgement of another system; the vehicle stays silent."""
        self.send_as(mav.Ack(command.command, mav.ACCEPTED, 0, 0, 0, 0), 77, 1)
        return None


PX4_PAGE = "PX4 user guide, Offboard Mode"
COMMON = "MAVLink common, SET_POSITION_TARGET_LOCAL_NED"
OBSERVED = f"{COMMON}; {mav.OBSERVED_BOTH}"
OWN_RULE = "this project's own rule"
MIN_RATE_HZ = 2.0
MAX_GAP_S = 0.5
MAX_RATE_HZ = 55.0
LISTEN_S = 5.0
REACTION_S = 1.0
QUIET_S = 2.0
"""PX4 may report the failsafe that took the mode one HEARTBEAT, a second, after the mode."""
STAYS_M = 2.0
GROUPS = (7, 56, 448)
"""Bits of position, velocity and acceleration in a mask."""
NEVER_NAN = ("vx", "vy", "vz", "afx", "afy", "afz", "yaw", "yaw_rate")
LOCAL_FRAMES = {Flavour.PX4: (1, 8), Flavour.ARDUPILOT: (1, 7, 8, 9)}
GLOBAL_FRAMES = {Flavour.PX4: (5, 6), Flavour.ARDUPILOT: (0, 3, 5, 6)}
FOREIGN_MODES = {Flavour.PX4: ("position", "return"), Flavour.ARDUPILOT: ("loiter", "return")}
FAR_M = 1_000.0


class SetpointRules(CompanionProbe):
    """The setpoint stream of a companion."""

    book = RuleBook("setpoints")

    def _require_rate(self) -> float:
        """Require a stream without gaps; return its rate."""
        mark = self.mark
        self.run(LISTEN_S)
        times = self.times(SETPOINTS, mark)
        require(len(times) > 1, f"{len(times)} setpoints in {LISTEN_S:g} s")
        gap_s = max(later - earlier for earlier, later in itertools.pairwise(times))
        rate_hz = len(times) / LISTEN_S
        is_good = rate_hz >= MIN_RATE_HZ and gap_s <= MAX_GAP_S
        require(is_good, f"{rate_hz:.1f} Hz, gap {gap_s:.2f} s")
        return rate_hz

    def _all_setpoints(self) -> list[SetpointMessage]:
        self.give_control()
        self.run(2.0)
        return self.setpoints()

    def _late_setpoints(self, mode: str, listen_s: float = LISTEN_S) -> int:
        """Count the setpoints that arrive more than a second after another mode was selected."""
        self.choose(mode)
        self.run(REACTION_S)
        mark = self.mark
        self.run(listen_s)
        return len(self.setpoints(mark))

    def _require_undisturbed(self, beat: Message, sender: tuple[int, int]) -> None:
        """Require setpoints for 3 s while another system sends a HEARTBEAT each second."""
        self.give_control()
        mark = self.mark
        for _ in range(3):
            self.send_as(beat, *sender)
            self.run(1.0)
        count = len(self.setpoints(mark))
        require(count >= MIN_RATE_HZ * 3.0, f"{count} setpoints in 3 s")

    @book.rule(PX4_PAGE, flavours=PX4)
    def stream_runs_before_the_mode(self) -> None:
        """Setpoints flow at 2 Hz or more before OFFBOARD is chosen."""
        self.await_setpoints()
        self._require_rate()

    @book.rule(PX4_PAGE)
    def stream_goes_on_in_the_mode(self) -> None:
        """In OFFBOARD or GUIDED setpoints flow at 2 Hz or more, without gaps, and not too fast."""
        self.give_control()
        rate_hz = self._require_rate()
        require(rate_hz <= MAX_RATE_HZ, f"{rate_hz:.0f} Hz")

    @book.rule(ROUTING)
    def setpoints_name_the_vehicle(self) -> None:
        """Setpoints are addressed to the autopilot, system and component."""
        self.require_addressed(self._all_setpoints())

    @book.rule(OBSERVED)
    def frame_is_one_the_vehicle_knows(self) -> None:
        """coordinate_frame is one that the autopilot flies."""
        for message in self._all_setpoints():
            is_local = isinstance(message, LocalTarget)
            known = (LOCAL_FRAMES if is_local else GLOBAL_FRAMES)[self.flavour]
            require(message.coordinate_frame in known, f"frame {message.coordinate_frame}")

    @book.rule(
        f"{COMMON}, POSITION_TARGET_TYPEMASK; ArduPilot wiki, Copter Commands in Guided Mode"
    )
    def type_mask_leaves_whole_groups(self) -> None:
        """The mask leaves a whole position, velocity or acceleration, never the FORCE bit."""
        for message in self._all_setpoints():
            mask = message.type_mask
            require(not mask & mav.FORCE, f"mask {mask:#x} has FORCE_SET")
            is_whole = all(mask & bits in (0, bits) for bits in GROUPS)
            require(is_whole, f"mask {mask:#x} splits a group")
            require(any(mask & bits == 0 for bits in GROUPS), f"mask {mask:#x} asks for nothing")

    @book.rule(OBSERVED)
    def used_fields_are_finite(self) -> None:
        """No field is NaN or infinite, used or not: ArduPilot has died of it."""
        for message in self._all_setpoints():
            axes = ("x", "y", "z") if isinstance(message, LocalTarget) else ("alt",)
            for name in NEVER_NAN + axes:
                require(math.isfinite(getattr(message, name)), f"{name} in {brief(message)}")

    @book.rule(f"{OWN_RULE}: nothing protects an autopilot from a wrong setpoint")
    def setpoints_stay_near(self) -> None:
        """A position setpoint is less than a kilometre away from the vehicle."""
        for message in self._all_setpoints():
            if message.type_mask & 7:
                continue
            if isinstance(message, LocalTarget):
                distance_m = math.dist(position_of(message), (10.0, 10.0, self.down_m))
            else:
                position = (message.lat_int, message.lon_int)
                distance_m = math.dist(position, ORIGIN_E7_MM[:2]) * METRES_PER_E7
            require(distance_m < FAR_M, f"{distance_m:.0f} m away")

    @book.rule("MAVLink common, SET_POSITION_TARGET_LOCAL_NED.time_boot_ms")
    def stamps_rise(self) -> None:
        """time_boot_ms never goes back."""
        stamps = [message.time_boot_ms for message in self._all_setpoints()]
        for earlier, later in itertools.pairwise(stamps):
            require(later >= earlier, f"{earlier} is followed by {later}")

    @book.rule(f"{mav.OBSERVED_BOTH}: a stream still running acts when the mode returns")
    def foreign_mode_ends_the_stream(self) -> None:
        """Setpoints stop within a second after the operator leaves the mode.

        A stream that makes ready for the next time begins no sooner than two seconds after the
        mode, only where the autopilot needs it, and moves nothing.
        """
        self.give_control()
        late = self._late_setpoints(FOREIGN_MODES[self.flavour][0], QUIET_S - REACTION_S)
        require(not late, f"{late} setpoints after the mode was taken away")
        mark = self.mark
        self.run(LISTEN_S)
        for message in self.setpoints(mark):
            require(self.flavour in PX4, "setpoints that this autopilot does not need")
            if isinstance(message, LocalTarget):
                off_m = math.dist(position_of(message), (10.0, 10.0, self.down_m))
                require(off_m <= STAYS_M, f"a setpoint {off_m:.1f} m away in another mode")

    @book.rule(f"{OWN_RULE}: a mode that was taken away is not taken back")
    def taken_mode_is_not_asked_back(self) -> None:
        """It does not command its mode again after the operator took it away."""
        self.give_control()
        self.choose(FOREIGN_MODES[self.flavour][0])
        mark = self.mark
        self.run(8.0)
        for command in self.commands(mark):
            require(command.command != mavlink.MAV_CMD_DO_SET_MODE, brief(command))
        require(not self.heard(mavlink.MAVLink_set_mode_message, mark), "SET_MODE was sent")

    @book.rule(f"{mav.OBSERVED_PX4} (returning setpoints return OFFBOARD)")
    def failsafe_ends_the_stream(self) -> None:
        """Setpoints stop when a failsafe changes the mode: a stream would take control back."""
        self.give_control()
        self.is_failsafe = True
        late = self._late_setpoints(FOREIGN_MODES[self.flavour][1])
        self.is_failsafe = False
        require(not late, f"{late} setpoints during the failsafe")

    @book.rule(HEARTBEAT_SERVICE)
    def lost_vehicle_ends_control(self) -> None:
        """After five seconds of silence from the vehicle no new motion is commanded."""
        self.give_control()
        self.go_silent()
        self.run(6.0)
        mark = self.mark
        self.run(2.0)
        positions = {position_of(message) for message in self.setpoints(mark)}
        self.come_back()
        require(len(positions) <= 1, f"{len(positions)} different setpoints to a silent vehicle")

    @book.rule(ROUTING)
    def other_vehicles_mode_changes_nothing(self) -> None:
        """Another vehicle's heartbeat, in any mode, neither starts nor stops the stream."""
        self._require_undisturbed(mav.Heartbeat(2, 12, 0x81, 0x50000 | 4 << 16, 4, 3), (77, 1))

    @book.rule(f"{HEARTBEAT_SERVICE} (heartbeats of others are forwarded)")
    def ground_stations_heartbeat_changes_nothing(self) -> None:
        """A ground station's forwarded heartbeat, which shows no mode, does not stop the stream."""
        self._require_undisturbed(mav.Heartbeat(6, 8, 0, 0, 4, 3), (255, 190))

    @book.rule(f"{OWN_RULE}: control is given, not found")
    def disarmed_vehicle_is_not_armed_unasked(self) -> None:
        """A disarmed vehicle is not armed unless it is set to launch by itself."""
        self.is_armed = False
        self.down_m = 0.0
        mark = self.mark
        self.run(8.0)
        forces = [c.param2 for c in self.commands(mark) if c.command == mav.ARM]
        is_by_force = forces[:1] in ([], [mav.FORCE_DISARM])
        assume(is_by_force, "it is configured to launch by itself")
        require(not forces, "armed by force")
