"""Signing, and the clocks it rests on: PING, TIMESYNC and timestamps."""

from __future__ import annotations

from collections.abc import Callable

from companion.mav.dialect import mavlink
from sim_link.lab.conformance import mavlink_oracle as mav
from sim_link.lab.conformance.mavlink_oracle import SIGNED, sign
from sim_link.lab.conformance.rules import PX4, NotApplicable, RuleBook, Violation, require
from sim_link.lab.conformance.station import Heard, Signer
from sim_link.lab.conformance.vehicle_probe import VehicleProbe
from sim_link.lab.conformance.vehicle_rules.frame_rules import FrameProbe

PING = "MAVLink guide, Ping Protocol"
TIME = "MAVLink guide, Time Synchronization"


class ClockRules(VehicleProbe):
    """PING and TIMESYNC."""

    book = RuleBook("clocks")

    def _synchronise(self, stamp: int) -> mav.Timesync:
        return self.ask(mav.Timesync(0, stamp), mav.Timesync, lambda m: m.ts1 == stamp)

    @book.rule(PING)
    def ping_request_is_answered(self) -> None:
        """A PING to 0/0 is answered to its sender with the same time and sequence."""
        request = mav.Ping(123_456_789, 4_711, 0, 0)
        if not self.is_px4:
            self.require_no_answer([request], mav.Ping, lambda m: m.seq == 4_711)
            return
        answer = self.ask(request, mav.Ping, lambda m: m.seq == 4_711)
        require(answer.time_usec == 123_456_789, f"time {answer.time_usec}")
        target = (answer.target_system, answer.target_component)
        require(target == self.address, f"target {target}")

    @book.rule(PING)
    def ping_response_is_never_answered(self) -> None:
        """A PING with a target is a response, and is not answered."""
        pings = [mav.Ping(1, 4_712, *target) for target in (self.target, (77, 1), (0, 1))]
        self.require_no_answer(pings, mav.Ping, lambda m: m.seq == 4_712)

    @book.rule(TIME)
    def timesync_request_is_answered(self) -> None:
        """TIMESYNC with tc1 = 0 is answered with ts1 mirrored and the vehicle's own time."""
        began = self._synchronise(987_654_321).tc1
        require(began > 0, f"tc1 {began}")
        self.run(1.0)
        elapsed_s = (self._synchronise(987_654_322).tc1 - began) / 1e9
        require(abs(elapsed_s - 1.0) < 0.25, f"tc1 went on by {elapsed_s:.2f} s in 1 s")

    @book.rule(TIME)
    def timesync_response_is_never_answered(self) -> None:
        """TIMESYNC with tc1 is a response, and is not answered."""
        response = mav.Timesync(55, 987_654_323)
        self.require_no_answer([response], mav.Timesync, lambda m: m.ts1 == response.ts1)

    @book.rule(f"{TIME} (target fields)", flavours=PX4)
    def timesync_answer_names_the_asker(self) -> None:
        """The answer to a TIMESYNC with our target fields names us as its target."""
        mark = len(self.datagrams)
        self.send(mav.Timesync(0, 987_654_324))
        self.run(0.3)
        for data in self.frames_since(mark):
            if data[7:10] == b"\x6f\x00\x00" and (987_654_324).to_bytes(4, "little") in data:
                target = tuple(data[10 + 16 : 10 + data[1]])
                require(target in (self.address, ()), f"target {target}")
                return
        raise Violation("no answer")


SIGNING = "MAVLink guide, Message Signing"
PYMAVLINK_BUG = f"{SIGNING}; pymavlink 2.4.50 check_signature gets it wrong"
MINUTE = 60 * mav.SIGNING_UNITS_PER_S
YEAR = 365 * 24 * 60 * MINUTE
FOREIGN_KEY = b"\x5a" * 32
LISTEN_S = 3.0
OTHER_LINK_ID = 9


class SigningRules(FrameProbe):
    """Signed and unsigned frames to a vehicle with a key."""

    book = RuleBook("signing")

    @property
    def _key(self) -> bytes:
        """The vehicle's key; `NotApplicable`: it has none that we know."""
        if self.signing_key is None:
            raise NotApplicable("no key known (--signing-key)")
        return self.signing_key

    def _signatures_after(self, wait_s: float) -> list[tuple[Heard, mav.Signature | None]]:
        """Return the messages of the vehicle until after a while, with their signatures."""
        key = self._key
        self.run(wait_s)
        heard = [entry for entry in self.inbox if entry.source == self.target]
        return [(entry, mav.signature_of(entry.frame, key)) for entry in heard]

    def _newest_timestamp(self) -> int:
        stamps = [s.timestamp for _, s in self._signatures_after(1.5) if s is not None]
        require(bool(stamps), "it sends nothing signed")
        return max(stamps)

    def _begin(self) -> Signer:
        """Sign from now on, a little later than everything that the vehicle signed so far."""
        key = self._key
        self.signer = Signer(key, self._newest_timestamp() + mav.SIGNING_UNITS_PER_S)
        require(self.is_alive(), "a rightly signed request is not answered")
        return self.signer

    def _is_taken(self, finish: Callable[[bytes], bytes], *, version: int = 2) -> bool:
        """Return True if a request is answered, its unsigned frame completed by `finish`."""
        message = self.question()
        incompat = SIGNED if version == 2 else 0
        frame = mav.build_frame(message, self.spec(version=version, incompat=incompat))
        return self.is_answered(finish(frame), message.ts1, 0.5)

    def _is_signed_taken(self, key: bytes, link_id: int, timestamp: int) -> bool:
        return self._is_taken(lambda frame: sign(frame, key, link_id, timestamp))

    @book.rule(SIGNING)
    def right_signature_is_accepted(self) -> None:
        """A frame signed with the vehicle's key is handled."""
        self._begin()

    @book.rule(SIGNING)
    def everything_is_sent_signed(self) -> None:
        """With a key the vehicle signs everything it sends, from the start, in MAVLink 2."""
        for entry, signature in self._signatures_after(LISTEN_S):
            name = entry.message.get_type()
            require(entry.frame[0] == mav.MAGIC_V2, f"{name} is sent in MAVLink 1")
            require(signature is not None, f"{name} is not signed")
            require(signature is not None and signature.is_right, f"{name} has a wrong signature")

    @book.rule(SIGNING)
    def own_timestamps_only_rise(self) -> None:
        """Timestamps rise with every frame of a component and link id."""
        last: dict[int, int] = {}
        for _, signature in self._signatures_after(LISTEN_S):
            if signature is not None:
                before = last.get(signature.link_id, -1)
                require(signature.timestamp > before, f"{signature.timestamp} after {before}")
                last[signature.link_id] = signature.timestamp
        require(bool(last), "nothing signed was heard")

    @book.rule(SIGNING)
    def unsigned_frame_is_dropped(self) -> None:
        """An unsigned frame has no effect."""
        self._begin()
        message = self.question()
        frame = mav.build_frame(message, self.spec())
        require(not self.is_answered(frame, message.ts1, 0.5), "an unsigned request is answered")

    @book.rule(SIGNING)
    def downgrade_is_dropped(self) -> None:
        """A MAVLink 1 frame, which cannot be signed, has no effect."""
        self._begin()
        taken = self._is_taken(lambda frame: frame, version=1)
        require(not taken, "a MAVLink 1 request is answered")

    @book.rule(SIGNING)
    def wrong_signature_is_dropped(self) -> None:
        """A frame with a wrong signature, or signed with another key, has no effect."""
        signer = self._begin()
        stamp = signer.timestamp + 100

        def broken(frame: bytes) -> bytes:
            done = sign(frame, signer.key, signer.link_id, stamp)
            return done[:-1] + bytes((done[-1] ^ 1,))

        require(not self._is_taken(broken), "taken with one bit of the signature changed")
        foreign = self._is_signed_taken(FOREIGN_KEY, signer.link_id, stamp + 1)
        require(not foreign, "taken with another key's signature")

    @book.rule(SIGNING)
    def replay_is_dropped(self) -> None:
        """A frame heard before has no effect when it is sent again."""
        signer = self._begin()
        message = self.question()
        frame = signer.sign(mav.build_frame(message, self.spec(incompat=SIGNED)))
        require(self.is_answered(frame, message.ts1), "the first one is not answered")
        require(not self.is_answered(frame, message.ts1, 0.5), "the second one is answered, too")

    @book.rule(SIGNING)
    def older_timestamp_is_dropped(self) -> None:
        """A frame older than the newest of its stream has no effect."""
        signer = self._begin()
        taken = self._is_signed_taken(signer.key, signer.link_id, signer.timestamp - 1)
        require(not taken, "an older one is answered")

    @book.rule(SIGNING)
    def new_stream_may_not_be_a_minute_old(self) -> None:
        """The first frame of a stream is dropped if it is more than a minute behind."""
        signer = self._begin()
        old, near = signer.timestamp - 3 * MINUTE, signer.timestamp - MINUTE // 4
        taken = self._is_signed_taken(signer.key, OTHER_LINK_ID, old)
        require(not taken, "a new stream three minutes behind is taken")
        taken = self._is_signed_taken(signer.key, OTHER_LINK_ID + 1, near)
        require(taken, "a new stream 15 s behind is dropped")

    @book.rule(PYMAVLINK_BUG)
    def forged_future_timestamp_locks_none_out(self) -> None:
        """A forged frame with a timestamp of the future does not stop the real peer."""
        signer = self._begin()
        for link_id in (signer.link_id, OTHER_LINK_ID):
            self._is_signed_taken(FOREIGN_KEY, link_id, signer.timestamp + YEAR)
        require(self.is_alive(), "the real peer is not answered any more")

    @book.rule(PYMAVLINK_BUG)
    def forged_timestamp_does_not_move_the_vehicle_clock(self) -> None:
        """A forged frame does not change the timestamps that the vehicle sends with."""
        signer = self._begin()
        self._is_signed_taken(FOREIGN_KEY, OTHER_LINK_ID, signer.timestamp + YEAR)
        newest = self._newest_timestamp()
        require(newest < signer.timestamp + YEAR // 2, "its clock followed the forged one")

    @book.rule(SIGNING)
    def broken_frames_do_not_disturb_signed_ones(self) -> None:
        """Garbage before a signed frame costs nothing."""
        signer = self._begin()
        message = self.question()
        frame = signer.sign(mav.build_frame(message, self.spec(incompat=SIGNED)))
        require(self.is_answered(frame[:20] + frame, message.ts1), "not found behind half a frame")

    @book.rule(SIGNING)
    def radio_status_needs_no_signature(self) -> None:
        """An unsigned RADIO_STATUS, which a radio injects, does no harm and opens no access."""
        self._begin()
        radio = mavlink.MAVLink_radio_status_message(100, 100, 50, 10, 10, 0, 0)
        self.send_raw(mav.build_frame(radio, self.spec()))
        self.require_hearing()
