"""Frames: checksums, flags, truncation and source ids; garbage costs nothing but itself."""

from __future__ import annotations

import itertools
from dataclasses import replace

from companion.mav.dialect import mavlink
from sim_link.lab.conformance import mavlink_oracle as mav
from sim_link.lab.conformance.mavlink_oracle import MAGIC_V1, MAGIC_V2, FrameSpec
from sim_link.lab.conformance.rules import RuleBook, require
from sim_link.lab.conformance.station import heartbeat
from sim_link.lab.conformance.vehicle_probe import ACK_S, VehicleProbe

SERIALIZATION = "MAVLink guide, Packet Serialization"
RESYNCHRONISING = f"{SERIALIZATION} (resynchronising is this project's own rule)"
VERSIONS = "MAVLink guide, MAVLink Versions"
UNKNOWN_ID = 45_999
LISTEN_S = 3.0
LONGEST_FRAME, SHORTEST_HEARTBEAT = 280, 17


class FrameProbe(VehicleProbe):
    """Asks by frames made by hand."""

    def question(self) -> mav.Timesync:
        """Return a TIMESYNC request that no other was like."""
        return mav.Timesync(0, 7_000_000_000 + self.mark)

    def is_answered(
        self, data: bytes, asked: int, within_s: float = ACK_S, *, has_junk: bool = False
    ) -> bool:
        """Return True if a TIMESYNC with `ts1` = `asked` is answered after `data` was sent."""
        mark = self.mark
        self.send_raw(data)
        if has_junk:
            self.push_through()
        return self.is_synchronised(asked, mark, within_s)

    def push_through(self) -> None:
        """Send as many bytes on a byte stream as a lying length byte can make a parser wait for."""
        if not self.link.is_datagram:
            for _ in range(LONGEST_FRAME // SHORTEST_HEARTBEAT + 1):
                self.send(heartbeat(mavlink.MAV_TYPE_GCS))


class FrameRules(FrameProbe):
    """Handling of good frames and bad ones."""

    book = RuleBook("frames")

    def _require_answer(self, spec: FrameSpec, problem: str) -> None:
        """Require that the vehicle accepts a TIMESYNC framed by `spec`."""
        message = self.question()
        require(self.is_answered(mav.build_frame(message, spec), message.ts1), problem)

    def _require_silence(self, spec: FrameSpec, problem: str) -> None:
        """Require no answer to a TIMESYNC framed by `spec`, but one to the next valid TIMESYNC."""
        message = self.question()
        self._require_dropped(mav.build_frame(message, spec), message.ts1, problem)

    def _require_dropped(self, frame: bytes, asked: int, problem: str) -> None:
        require(not self.is_answered(frame, asked, 0.5), problem)
        self.push_through()  # a byte of what was dropped may look like the beginning of a frame
        self.require_hearing()

    def _require_found_behind(self, junk: bytes, message: mav.Timesync, problem: str) -> None:
        frame = mav.build_frame(message, self.spec())
        require(self.is_answered(junk + frame, message.ts1, has_junk=True), problem)

    @book.rule(SERIALIZATION)
    def mavlink2_is_understood(self) -> None:
        """A MAVLink 2 frame is understood."""
        self._require_answer(self.spec(), "a MAVLink 2 request is not answered")

    @book.rule(VERSIONS)
    def mavlink1_is_understood(self) -> None:
        """A MAVLink 1 frame is understood, and answered in either version."""
        self._require_answer(self.spec(version=1), "a MAVLink 1 request is not answered")

    @book.rule(VERSIONS)
    def one_version_per_channel(self) -> None:
        """To a client that speaks MAVLink 2 every frame is MAVLink 2."""
        self.is_alive()
        versions = {entry.frame[0] for entry in self.listen(LISTEN_S)}
        require(versions == {MAGIC_V2}, f"magic bytes {sorted(map(hex, versions))}")

    @book.rule(f"{VERSIONS}; MAVLink common, MAV_PROTOCOL_CAPABILITY")
    def mavlink2_capability_is_reported(self) -> None:
        """AUTOPILOT_VERSION has the MAVLINK2 capability."""
        capabilities = self.request(mav.Version).capabilities
        bit = mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
        require(bool(capabilities & bit), f"capabilities {capabilities:#x}")

    @book.rule(SERIALIZATION)
    def trailing_zeros_are_cut(self) -> None:
        """A sent MAVLink 2 payload ends in no zero byte, except a single one."""
        self.run(LISTEN_S)
        for entry in self.inbox:
            if entry.frame[0] == MAGIC_V2 and entry.source == self.target:
                payload, name = entry.payload, entry.message.get_type()
                is_cut = len(payload) == 1 or (len(payload) > 1 and payload[-1] != 0)
                require(is_cut, f"{name} carries {len(payload)} bytes, the last one zero")

    @book.rule(SERIALIZATION)
    def uncut_payload_is_accepted(self) -> None:
        """A payload whose trailing zeros were not cut is understood."""
        self._require_answer(replace(self.spec(), trim=False), "an uncut TIMESYNC is not answered")

    @book.rule(SERIALIZATION)
    def cut_payload_is_accepted(self) -> None:
        """A payload whose trailing zeros were cut is understood."""
        message = mav.Timesync(0, 1 + self.mark)  # its stamp ends in zeros
        is_taken = self.is_answered(mav.build_frame(message, self.spec()), message.ts1)
        require(is_taken, "a cut TIMESYNC is not answered")

    @book.rule(f"{SERIALIZATION} (extension fields are no part of CRC_EXTRA)")
    def message_without_its_extensions_is_understood(self) -> None:
        """A message that ends before its extension fields, as in MAVLink 1, is understood."""
        message = mav.PlanRequest(*self.target, 0)
        short = mav.payload_of(message)[: mav.base_length(message)]
        frames = {
            "MAVLink 2": mav.build_raw(message.id, short, message.crc_extra, self.spec()),
            "MAVLink 1": mav.build_frame(message, self.spec(version=1)),
        }
        for version, frame in frames.items():
            self.send_raw(frame)
            what, mark = f"answer to one in {version}", self.asked
            self.expect(mav.Count, lambda m: m.mission_type == 0, mark=mark, what=what)
            self.send(mav.PlanAck(*self.target, 0, 0))

    @book.rule(VERSIONS)
    def mavlink1_frame_is_sent_whole_and_without_extensions(self) -> None:
        """Frames sent in MAVLink 1, if any, have their whole payload and no extensions."""
        self.send_raw(mav.build_frame(self.question(), self.spec(version=1)))
        self.run(LISTEN_S)
        for entry in self.inbox[self.asked :]:
            if entry.frame[0] == MAGIC_V1:
                name, wanted = entry.message.get_type(), mav.base_length(entry.message)
                require(entry.frame[1] == wanted, f"{name}: {entry.frame[1]} bytes, not {wanted}")
        self.require_hearing()

    @book.rule(SERIALIZATION)
    def bad_crc_is_dropped(self) -> None:
        """A frame whose CRC is wrong has no effect."""
        for change in (0x0001, 0x8000, 0xFFFF):
            spec = replace(self.spec(), crc_change=change)
            self._require_silence(spec, f"taken with its CRC changed by {change:#06x}")

    @book.rule(SERIALIZATION)
    def wrong_crc_extra_is_dropped(self) -> None:
        """A frame made with another CRC_EXTRA, as from another dialect, has no effect."""
        message = self.question()
        payload = mav.build_frame(message, replace(self.spec(), trim=False))[10:26]
        frame = mav.build_raw(message.id, payload, message.crc_extra ^ 1, self.spec())
        self._require_dropped(frame, message.ts1, "taken with a wrong CRC_EXTRA")

    @book.rule(SERIALIZATION)
    def unknown_incompat_bit_is_dropped(self) -> None:
        """A frame with an unknown bit in `incompat_flags` is dropped."""
        for bit in (0x02, 0x40, 0x80):
            self._require_silence(self.spec(incompat=bit), f"taken with incompat {bit:#04x}")

    @book.rule(SERIALIZATION)
    def unknown_compat_bit_is_handled(self) -> None:
        """A frame with an unknown bit in `compat_flags` is handled as usual."""
        for bit in (0x01, 0x80, 0xFF):
            self._require_answer(self.spec(compat=bit), f"dropped with compat {bit:#04x}")

    @book.rule("MAVLink guide, MAVLink IDs; MAVSDK drops system 0 as well")
    def source_system_zero_is_ignored(self) -> None:
        """A frame from system 0, which is not allowed, has no effect."""
        spec = replace(self.spec(), system_id=0)
        self._require_silence(spec, "a request from system 0 is answered")

    @book.rule(
        "pymavlink mavutil.mavlink_connection, source_component=0 by default; the MAVLink guide "
        "assigns 0 to no system, but scripts that leave it so depend on it"
    )
    def source_component_zero_is_heard(self) -> None:
        """A frame from component 0, as pymavlink sends by default, is handled."""
        spec = replace(self.spec(), component_id=0)
        self._require_answer(spec, "a request from component 0 is not answered")

    @book.rule("MAVLink guide, Packet Loss")
    def sequence_counts_every_message(self) -> None:
        """The sequence number goes up by one, modulo 256, with each message of a component."""
        self.run(LISTEN_S)
        counts = [e.message.get_seq() for e in self.inbox if e.source == self.target]
        require(len(counts) > 2, "too few messages to judge")
        for first, second in itertools.pairwise(counts):
            require(second == (first + 1) % 256, f"sequence {first} is followed by {second}")

    @book.rule(RESYNCHRONISING)
    def garbage_costs_nothing(self) -> None:
        """A good frame behind garbage is found."""
        for garbage in (b"\x00\x01\x02", bytes((MAGIC_V2,)), bytes((MAGIC_V1, 3)), b"\xff" * 40):
            problem = f"not found behind {garbage[:4].hex()}... ({len(garbage)} bytes)"
            self._require_found_behind(garbage, self.question(), problem)

    @book.rule(RESYNCHRONISING)
    def truncated_frame_costs_nothing(self) -> None:
        """A good frame behind half a frame is found: a bad CRC costs one byte."""
        for share in (5, 11, 20):
            message = self.question()
            half = mav.build_frame(message, self.spec())[:share]
            problem = f"not found behind the first {share} bytes of another"
            self._require_found_behind(half, message, problem)

    @book.rule(SERIALIZATION)
    def several_frames_in_one_piece(self) -> None:
        """All frames of one datagram, or of one read, are taken."""
        first, second = self.question(), self.question()
        second.ts1 = first.ts1 + 1
        mark = self.mark
        self.send_raw(b"".join(mav.build_frame(m, self.spec()) for m in (first, second)))
        for stamp in (first.ts1, second.ts1):
            require(self.is_synchronised(stamp, mark, ACK_S), f"{stamp} is not answered")

    @book.rule(SERIALIZATION)
    def unknown_message_id_is_ignored(self) -> None:
        """A frame with an unknown message id has no effect."""
        self.send_raw(mav.build_raw(UNKNOWN_ID, b"\x01\x02\x03\x04", 17, self.spec()))
        self.require_hearing()

    @book.rule(SERIALIZATION)
    def every_sent_frame_has_a_right_crc(self) -> None:
        """Frames of the vehicle pass their CRC."""
        self.run(LISTEN_S)
        counters = self.reader.counters
        require(counters.good > 0, "nothing was heard")
        require(counters.bad_crc == 0, f"{counters.bad_crc} frames are broken")

    @book.rule("MAVLink guide, MAVLink IDs")
    def sends_valid_source_ids(self) -> None:
        """Every frame has a source system and component from 1 to 255."""
        self.run(LISTEN_S)
        for entry in self.inbox:
            require(min(entry.source) >= 1, f"{entry.message.get_type()} from {entry.source}")
