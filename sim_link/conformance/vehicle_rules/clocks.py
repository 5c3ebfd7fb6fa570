"""PING and TIMESYNC: requests are answered, answers never."""

from __future__ import annotations

from companion.mav.dialect import mavlink
from sim_link.conformance.rules import (
    BOTH,
    PX4_ONLY,
    Role,
    RuleBook,
    Violation,
    require,
)
from sim_link.conformance.vehicle_probe import VehicleProbe

book = RuleBook(Role.VEHICLE, "clocks")
Ping = mavlink.MAVLink_ping_message
Timesync = mavlink.MAVLink_timesync_message


@book.rule("MAVLink guide, Ping Protocol", flavours=BOTH, ardupilot="never answers")
def ping_request_is_answered(probe: VehicleProbe) -> None:
    """A PING to 0/0 is answered to its sender with the same time and sequence."""
    mark = probe.mark
    probe.send(mavlink.MAVLink_ping_message(123_456_789, 4_711, 0, 0))
    if not probe.is_px4:
        probe.expect_none(Ping, lambda m: m.seq == 4_711, mark=mark, what="answered")
        probe.require_hearing()
        return
    answer = probe.expect(Ping, lambda m: m.seq == 4_711, mark=mark)
    require(answer.time_usec == 123_456_789, f"time {answer.time_usec}")
    target = (answer.target_system, answer.target_component)
    require(target == (probe.system_id, probe.component_id), f"target {target}")


@book.rule("MAVLink guide, Ping Protocol")
def ping_response_is_never_answered(probe: VehicleProbe) -> None:
    """A PING with a target is a response, and is not answered."""
    mark = probe.mark
    for target in (probe.target, (77, 1), (0, 1)):
        probe.send(mavlink.MAVLink_ping_message(1, 4_712, *target))
    probe.expect_none(Ping, lambda m: m.seq == 4_712, mark=mark, what="answered")
    probe.require_hearing()


@book.rule("MAVLink guide, Time Synchronization", ardupilot="answers without a target (v1 form)")
def timesync_request_is_answered(probe: VehicleProbe) -> None:
    """TIMESYNC with tc1 = 0 comes back with ts1 mirrored and the vehicle's own time."""
    mark = probe.mark
    probe.send(mavlink.MAVLink_timesync_message(0, 987_654_321))
    answer = probe.expect(Timesync, lambda m: m.ts1 == 987_654_321, mark=mark)
    require(answer.tc1 > 0, f"tc1 {answer.tc1}")
    probe.run(1.0)
    mark = probe.mark
    probe.send(mavlink.MAVLink_timesync_message(0, 987_654_322))
    later = probe.expect(Timesync, lambda m: m.ts1 == 987_654_322, mark=mark)
    elapsed_s = (later.tc1 - answer.tc1) / 1e9
    require(abs(elapsed_s - 1.0) < 0.25, f"tc1 went on by {elapsed_s:.2f} s in 1 s")


@book.rule("MAVLink guide, Time Synchronization")
def timesync_response_is_never_answered(probe: VehicleProbe) -> None:
    """TIMESYNC with tc1 is a response, and is not answered."""
    mark = probe.mark
    probe.send(mavlink.MAVLink_timesync_message(55, 987_654_323))
    probe.expect_none(Timesync, lambda m: m.ts1 == 987_654_323, mark=mark, what="answered")
    probe.require_hearing()


@book.rule("MAVLink guide, Time Synchronization (target fields)", flavours=PX4_ONLY)
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
