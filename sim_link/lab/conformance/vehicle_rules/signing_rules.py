"""Signing, and the clocks it rests on: PING, TIMESYNC and timestamps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from companion.mav.dialect import mavlink
from sim_link.lab.conformance.mavlink_oracle import (
    MAGIC_V2,
    SIGNED,
    SIGNING_UNITS_PER_S,
    Signature,
    build_frame,
    sign,
    signature_of,
)
from sim_link.lab.conformance.rules import (
    PX4_ONLY,
    NotApplicable,
    Role,
    RuleBook,
    Violation,
    require,
)
from sim_link.lab.conformance.station import Heard, Signer
from sim_link.lab.conformance.vehicle_probe import VehicleProbe
from sim_link.lab.conformance.vehicle_rules.frame_rules import is_answered, question

clock_book = RuleBook(Role.VEHICLE, "clocks")
Ping = mavlink.MAVLink_ping_message
Timesync = mavlink.MAVLink_timesync_message


def synchronise(probe: VehicleProbe, stamp: int) -> Timesync:
    """TIMESYNC; the answer."""
    return probe.ask(Timesync(0, stamp), Timesync, lambda m: m.ts1 == stamp)


@clock_book.rule("MAVLink guide, Ping Protocol", ardupilot="never answers")
def ping_request_is_answered(probe: VehicleProbe) -> None:
    """A PING to 0/0 is answered to its sender with the same time and sequence."""
    request = mavlink.MAVLink_ping_message(123_456_789, 4_711, 0, 0)
    if not probe.is_px4:
        probe.require_no_answer(request, Ping, lambda m: m.seq == 4_711)
        return
    answer = probe.ask(request, Ping, lambda m: m.seq == 4_711)
    require(answer.time_usec == 123_456_789, f"time {answer.time_usec}")
    target = (answer.target_system, answer.target_component)
    require(target == (probe.system_id, probe.component_id), f"target {target}")


@clock_book.rule("MAVLink guide, Ping Protocol")
def ping_response_is_never_answered(probe: VehicleProbe) -> None:
    """A PING with a target is a response, and is not answered."""
    targets = (probe.target, (77, 1), (0, 1))
    pings = [mavlink.MAVLink_ping_message(1, 4_712, *target) for target in targets]
    probe.require_no_answer(pings, Ping, lambda m: m.seq == 4_712)


@clock_book.rule(
    "MAVLink guide, Time Synchronization", ardupilot="answers without a target (v1 form)"
)
def timesync_request_is_answered(probe: VehicleProbe) -> None:
    """TIMESYNC with tc1 = 0 comes back with ts1 mirrored and the vehicle's own time."""
    answer = synchronise(probe, 987_654_321)
    require(answer.tc1 > 0, f"tc1 {answer.tc1}")
    probe.run(1.0)
    later = synchronise(probe, 987_654_322)
    elapsed_s = (later.tc1 - answer.tc1) / 1e9
    require(abs(elapsed_s - 1.0) < 0.25, f"tc1 went on by {elapsed_s:.2f} s in 1 s")


@clock_book.rule("MAVLink guide, Time Synchronization")
def timesync_response_is_never_answered(probe: VehicleProbe) -> None:
    """TIMESYNC with tc1 is a response, and is not answered."""
    response = Timesync(55, 987_654_323)
    probe.require_no_answer(response, Timesync, lambda m: m.ts1 == response.ts1)


@clock_book.rule("MAVLink guide, Time Synchronization (target fields)", flavours=PX4_ONLY)
def timesync_answer_names_the_asker(probe: VehicleProbe) -> None:
    """The answer to a TIMESYNC with our target fields names us as its target."""
    mark = len(probe.datagrams)
    probe.send(mavlink.MAVLink_timesync_message(0, 987_654_324))
    probe.run(0.3)
    for data in probe.frames_since(mark):
        if data[7:10] == b"\x6f\x00\x00" and (987_654_324).to_bytes(4, "little") in data:
            target = tuple(data[10 + 16 : 10 + data[1]])
            require(target in ((probe.system_id, probe.component_id), ()), f"target {target}")
            return
    raise Violation("no answer")


signing_book = RuleBook(Role.VEHICLE, "signing")
SIGNING = "MAVLink guide, Message Signing"
PYMAVLINK_BUG = f"{SIGNING}; pymavlink 2.4.50 check_signature gets it wrong"
MINUTE = 60 * SIGNING_UNITS_PER_S
YEAR = 365 * 24 * 60 * MINUTE
FOREIGN_KEY = b"\x5a" * 32
LISTEN_S = 3.0
OTHER_LINK_ID = 9


def key_of(probe: VehicleProbe) -> bytes:
    """The vehicle's key.

    Raises:
        NotApplicable: It has none that we know.
    """
    if probe.signing_key is None:
        raise NotApplicable("no key known (--signing-key)")
    return probe.signing_key


def signed_from_vehicle(probe: VehicleProbe) -> list[tuple[Heard, Signature | None]]:
    """What the vehicle sends, and what it is signed with."""
    key = key_of(probe)
    return [
        (entry, signature_of(entry.frame, key))
        for entry in probe.inbox
        if entry.source == probe.target
    ]


def begin(probe: VehicleProbe) -> Signer:
    """Sign from now on, a little later than everything that the vehicle signed so far."""
    key = key_of(probe)
    probe.run(1.5)
    stamps = [s.timestamp for _, s in signed_from_vehicle(probe) if s is not None]
    require(bool(stamps), "it sends nothing signed")
    probe.signer = Signer(key, max(stamps) + SIGNING_UNITS_PER_S)
    require(probe.is_alive(), "a rightly signed request is not answered")
    return probe.signer


def is_taken(probe: VehicleProbe, finish: Callable[[bytes], bytes], *, version: int = 2) -> bool:
    """Whether a request is answered, its unsigned frame completed by `finish`."""
    message = question(probe)
    incompat = SIGNED if version == 2 else 0
    frame = build_frame(message, probe.spec(version=version, incompat=incompat))
    return is_answered(probe, finish(frame), message.ts1, 0.5)


@signing_book.rule(SIGNING)
def right_signature_is_accepted(probe: VehicleProbe) -> None:
    """A frame signed with the vehicle's key is handled."""
    begin(probe)


@signing_book.rule(SIGNING)
def everything_is_sent_signed(probe: VehicleProbe) -> None:
    """With a key the vehicle signs what it sends, from the start, in MAVLink 2."""
    key_of(probe)
    probe.run(LISTEN_S)
    for entry, signature in signed_from_vehicle(probe):
        name = entry.message.get_type()
        require(entry.frame[0] == MAGIC_V2, f"{name} is sent in MAVLink 1")
        require(signature is not None, f"{name} is not signed")
        require(signature is not None and signature.is_right, f"{name} has a wrong signature")


@signing_book.rule(SIGNING)
def own_timestamps_only_rise(probe: VehicleProbe) -> None:
    """The timestamps of what is sent rise with every frame of a component and link id."""
    key_of(probe)
    probe.run(LISTEN_S)
    last: dict[int, int] = {}
    for _, signature in signed_from_vehicle(probe):
        if signature is not None:
            before = last.get(signature.link_id, -1)
            require(signature.timestamp > before, f"{signature.timestamp} after {before}")
            last[signature.link_id] = signature.timestamp
    require(bool(last), "nothing signed was heard")


@signing_book.rule(SIGNING)
def unsigned_frame_is_dropped(probe: VehicleProbe) -> None:
    """An unsigned frame has no effect."""
    signer = begin(probe)
    message = question(probe)
    probe.signer = None
    taken = is_answered(probe, build_frame(message, probe.spec()), message.ts1, 0.5)
    probe.signer = signer
    require(not taken, "an unsigned request is answered")


@signing_book.rule(SIGNING)
def downgrade_is_dropped(probe: VehicleProbe) -> None:
    """A MAVLink 1 frame, which cannot be signed, has no effect."""
    begin(probe)
    require(not is_taken(probe, lambda frame: frame, version=1), "a MAVLink 1 request is answered")


@signing_book.rule(SIGNING)
def wrong_signature_is_dropped(probe: VehicleProbe) -> None:
    """A frame with a wrong signature, or signed with another key, has no effect."""
    signer = begin(probe)
    stamp = signer.timestamp + 100

    def broken(frame: bytes) -> bytes:
        """The frame with a signature that is wrong by a bit."""
        done = sign(frame, signer.key, signer.link_id, stamp)
        return done[:-1] + bytes((done[-1] ^ 1,))

    require(not is_taken(probe, broken), "taken with one bit of the signature changed")
    foreign = is_taken(probe, lambda f: sign(f, FOREIGN_KEY, signer.link_id, stamp + 1))
    require(not foreign, "taken with another key's signature")


@signing_book.rule(SIGNING)
def replay_is_dropped(probe: VehicleProbe) -> None:
    """A frame heard before has no effect when it is sent again."""
    signer = begin(probe)
    message = question(probe)
    spec = replace(probe.spec(), incompat=SIGNED)
    frame = signer.sign(build_frame(message, spec))
    require(is_answered(probe, frame, message.ts1), "the first one is not answered")
    require(not is_answered(probe, frame, message.ts1, 0.5), "the second one is answered, too")


@signing_book.rule(SIGNING)
def older_timestamp_is_dropped(probe: VehicleProbe) -> None:
    """A frame older than the newest of its stream has no effect."""
    signer = begin(probe)
    stamp = signer.timestamp - 1
    taken = is_taken(probe, lambda f: sign(f, signer.key, signer.link_id, stamp))
    require(not taken, "an older one is answered")


@signing_book.rule(SIGNING)
def new_stream_may_not_be_a_minute_old(probe: VehicleProbe) -> None:
    """The first frame of a stream is dropped if it is more than a minute behind."""
    signer = begin(probe)
    old = signer.timestamp - 3 * MINUTE
    taken = is_taken(probe, lambda f: sign(f, signer.key, OTHER_LINK_ID, old))
    require(not taken, "a new stream three minutes behind is taken")
    near = signer.timestamp - MINUTE // 4
    taken = is_taken(probe, lambda f: sign(f, signer.key, OTHER_LINK_ID + 1, near))
    require(taken, "a new stream 15 s behind is dropped")


@signing_book.rule(PYMAVLINK_BUG)
def forged_future_timestamp_locks_nobody_out(probe: VehicleProbe) -> None:
    """A forged frame with a timestamp of the future does not stop the real peer."""
    signer = begin(probe)
    future = signer.timestamp + YEAR
    is_taken(probe, lambda f: sign(f, FOREIGN_KEY, signer.link_id, future))
    is_taken(probe, lambda f: sign(f, FOREIGN_KEY, OTHER_LINK_ID, future))
    require(probe.is_alive(), "the real peer is not answered any more")


@signing_book.rule(PYMAVLINK_BUG)
def forged_timestamp_does_not_move_the_vehicle_clock(probe: VehicleProbe) -> None:
    """A forged frame does not change the timestamps that the vehicle sends with."""
    signer = begin(probe)
    is_taken(probe, lambda f: sign(f, FOREIGN_KEY, OTHER_LINK_ID, signer.timestamp + YEAR))
    probe.run(1.5)
    newest = max(s.timestamp for _, s in signed_from_vehicle(probe) if s is not None)
    require(newest < signer.timestamp + YEAR // 2, "its clock followed the forged one")


@signing_book.rule(SIGNING)
def broken_frames_do_not_disturb_signed_ones(probe: VehicleProbe) -> None:
    """Garbage before a signed frame costs nothing."""
    signer = begin(probe)
    message = question(probe)
    frame = signer.sign(build_frame(message, replace(probe.spec(), incompat=SIGNED)))
    require(is_answered(probe, frame[:20] + frame, message.ts1), "not found behind half a frame")


@signing_book.rule(SIGNING)
def radio_status_needs_no_signature(probe: VehicleProbe) -> None:
    """An unsigned RADIO_STATUS, which a radio injects, does no harm and is no way in."""
    signer = begin(probe)
    radio = mavlink.MAVLink_radio_status_message(100, 100, 50, 10, 10, 0, 0)
    probe.signer = None
    probe.send(radio)
    probe.signer = signer
    probe.require_hearing()
