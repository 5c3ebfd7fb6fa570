"""Binding to one autopilot, and the check that its frames continue as one vehicle's.

Theory of operation. Every autopilot that is heard is a candidate. Without a configured system id
nothing is bound before all candidates had time to appear, and of two systems neither until one
vanishes or the operator chooses. Of one system, component 1 is preferred. After a restart of the
companion its vehicle is bound at once, if ids and boot clock continue.

The binding is more than its ids: the kind of vehicle, the address, and the course of its clock,
position and sequence (`companion.link.identity`). Contradicting frames are withheld, and `problem`
describes the doubt, which ends when the old course continues alone. An address may change, as after
a router's restart, if the course continues at the new one, with the same hardware id. A course that
continues there without a gap is followed at once. While the companion has no control, and the
vehicle is not one that it left in the air, another autopilot may replace one that vanished.

Source: MAVLink developer guide, "MAVLink Id Assignment" (listen for two systems for 3 s) and
"Heartbeat/Connection Protocol".
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from companion.domain import Autopilot
from companion.guidance.events import VehicleMark
from companion.link.candidates import VANISHED_S, Candidate, Candidates, Ids
from companion.link.identity import (
    DOUBT_S,
    JITTER_S,
    HardwareId,
    IdentityCourse,
    Sign,
    SignVerdict,
    Track,
    exchange_sign_of,
    sign_of,
    uid_of,
)
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Address
from companion.mav.flight_modes import autopilot_of, class_of, gives_control, is_of_component

LISTEN_S = 3.0
"""Time to wait for further candidates (MAVLink guide, see above)."""
MAX_ADDRESSES = 8
"""Limit of addresses that are kept: forged frames can invent any number."""
PEER_SILENCE_S = 3.0
"""Silence of the autopilot before the same ids are accepted from a new address."""
SURE_SILENCE_S = 0.5
"""That silence for signed frames, and for frames that continue the sequence, as behind a NAT that
binds another port: long enough that two paths to one autopilot do not alternate, shorter than the
second without setpoints after which PX4 leaves OFFBOARD."""
PROOF_PERIOD_S = 0.5
"""Interval of requests to an address for evidence of its vehicle."""


@dataclass(slots=True)
class AutopilotBinding:
    """Binding to our autopilot, if any.

    Autopilots forward other stations' heartbeats, so system, component and kind decide, and the
    address once it is known.
    """

    wanted_system_id: int | None = None
    is_keyed: bool = False
    """True if every incoming frame was verified to be signed with our key."""
    bound: Candidate | None = None
    peer: Address | None = None
    heard_s: float | None = None
    binds: int = 0
    problem: str | None = None
    """Reason why no vehicle may be controlled now; None if one may."""
    is_in_control: bool = False
    is_committed: bool = False
    """True if it is in the air, or was when last received, after the companion had control."""
    unknown_senders: int = 0
    """Frames with the autopilot's ids from another address."""
    moves: int = 0
    candidates: Candidates = field(default_factory=Candidates)
    _course: IdentityCourse = field(default_factory=IdentityCourse)
    _exchange: IdentityCourse = field(default_factory=IdentityCourse)
    hardware: HardwareId = field(default_factory=HardwareId)
    _doubted_s: float = 0.0
    _kinds_s: dict[tuple[Autopilot, int], float] = field(default_factory=dict)
    """Kinds that the bound ids had, and when they were last heard."""
    _expected: tuple[VehicleMark, Track] | None = None
    """The vehicle that an earlier process had, and its clock."""
    _elsewhere: dict[Address | None, IdentityCourse] = field(default_factory=dict)
    """Courses of the same ids at other addresses."""
    unproved: dict[Address | None, float] = field(default_factory=dict)
    """Addresses that may be the autopilot's now, and the time of the last request for evidence."""

    @property
    def is_bound(self) -> bool:
        """True if an autopilot is bound."""
        return self.bound is not None

    @property
    def system_id(self) -> int | None:
        """System id of the bound autopilot; None: none."""
        return None if self.bound is None else self.bound.ids[0]

    @property
    def component_id(self) -> int:
        """Component id of the bound autopilot."""
        return 0 if self.bound is None else self.bound.ids[1]

    @property
    def autopilot(self) -> Autopilot:
        """Kind of the bound autopilot."""
        return Autopilot.OTHER if self.bound is None else self.bound.autopilot

    @property
    def others(self) -> list[int]:
        """Systems of other autopilots, where none is configured."""
        ours = self.system_id
        if self.wanted_system_id is not None or ours is None:
            return []
        return sorted(
            {each.ids[0] for each in self.candidates.present(self.heard_s or 0.0)} - {ours}
        )

    @property
    def silence_s(self) -> float:
        """Seconds that the autopilot must be silent before another address is accepted."""
        return SURE_SILENCE_S if self.is_keyed else PEER_SILENCE_S

    def recognise(self, message: Message, peer: Address | None, now_s: float) -> bool:
        """Return True if a message is from the bound autopilot, and to be used; may bind to one."""
        header = message.get_header()
        ids = (header.srcSystem, header.srcComponent)
        if isinstance(message, mavlink.MAVLink_heartbeat_message) and self.candidates.take(
            message, peer, now_s, wanted_system_id=self.wanted_system_id, bound=self.bound
        ):
            self._choose(now_s)
        if self._expected is not None:
            self._bind_expected(sign_of(message), ids, peer, now_s)
        if self.bound is None or ids != self.bound.ids or is_of_component(message):
            return False
        sign = sign_of(message)
        if peer != self.peer:
            return self._take_elsewhere(message, sign, peer, now_s)
        if self._is_silent(now_s):
            self.hardware.ask_again()
        self.heard_s = now_s
        if self._course.note_sequence(header.seq, now_s):
            self.hardware.confirm(now_s, PEER_SILENCE_S)  # it may be another with the same clock
        if sign is not None:
            return self._take_sign(sign, now_s) and not self.is_doubted
        return self._compare_vehicle(message, now_s) and not self.is_doubted

    def _compare_vehicle(self, message: Message, now_s: float) -> bool:
        """Check type, hardware id or clock in a message; return False if it must not be used."""
        uid, exchange = uid_of(message), exchange_sign_of(message)
        if uid is not None and self.hardware.differs(uid, now_s):
            self._take_other_hardware(uid, now_s)
        if exchange is not None:
            # clocks in answers show two vehicles, but not a replaced one
            course = self._exchange
            match course.take(exchange, now_s, is_cautious=not self.is_in_control):
                case SignVerdict.TWO:
                    problem = f"two vehicles send as {self._name}: {course.difference}"
                    self._doubt(problem, now_s)
                case SignVerdict.ANOTHER:
                    course.adopt_other()
        if not isinstance(message, mavlink.MAVLink_heartbeat_message):
            return True
        self._compare_kind(message, now_s)
        is_given = not self.is_in_control and gives_control(message)
        # after a break it may be another vehicle's: wait for the next one
        return not (self._course.is_out_of_sequence and is_given)

    def hear(self, ids: Ids, peer: Address | None, now_s: float, sequence: int) -> bool:
        """Return the result of `recognise` for a frame that is not decoded."""
        if self.bound is None or ids != self.bound.ids:
            return False
        if peer != self.peer:
            self.unknown_senders += not self._is_silent(now_s)
            return False
        self.heard_s = now_s
        if self._course.note_sequence(sequence, now_s):
            self.hardware.confirm(now_s, PEER_SILENCE_S)
        return True

    def note_control(self, now_s: float, *, is_in_control: bool, is_armed: bool) -> None:
        """Note once per tick whether the companion has control and the vehicle is armed."""
        self.candidates.ticked_s = now_s
        self.is_in_control = is_in_control
        self.is_committed = is_in_control or (self.is_committed and is_armed)
        if not self.is_committed:
            self._choose(now_s)
        if self.problem is None or self._is_of_choice or now_s - self._doubted_s <= DOUBT_S:
            return
        if not self._is_silent(now_s):
            self.problem = None

    @property
    def is_doubted(self) -> bool:
        """True if frames are withheld because they may be another vehicle's."""
        return self.problem is not None and not self._is_of_choice

    def take_unproved(self, now_s: float) -> list[Address | None]:
        """Return the addresses to be asked now for evidence of their vehicle."""
        due = [at for at, asked_s in self.unproved.items() if now_s - asked_s >= PROOF_PERIOD_S]
        self.unproved.update(dict.fromkeys(due, now_s))
        return due

    # The vehicle of an earlier process

    def mark(self, now_s: float) -> VehicleMark | None:
        """Return the bound vehicle's identity; None as long as its clock was not followed."""
        main = self._course.main
        if self.bound is None or main is None or not main.is_steady:
            return None
        return VehicleMark(*self.bound.ids, self.hardware.uid, now_s - main.offset_s)

    def expect(self, vehicle: VehicleMark, now_s: float) -> None:
        """Bind the vehicle of an earlier process as soon as its boot clock is heard."""
        self._expected = vehicle, Track.begin(Sign(vehicle.boot_s), now_s)

    def _bind_expected(
        self, sign: Sign | None, ids: Ids, peer: Address | None, now_s: float
    ) -> None:
        """Bind a candidate that has ids and clock of the vehicle that is expected."""
        candidate = self.candidates.known.get(ids)
        if self._expected is None or self.bound is not None or sign is None:
            return
        if candidate is None or candidate.peer != peer:
            return
        vehicle, clock = self._expected
        is_clock_its = abs(clock.late_s(sign, now_s)) <= JITTER_S
        if ids == (vehicle.system_id, vehicle.component_id) and is_clock_its:
            self._bind(candidate)
            self.hardware.uid = vehicle.uid

    # Candidates

    def _choose(self, now_s: float) -> None:
        """Bind, wait or rebind, by the candidates that are present."""
        if self.is_committed:
            return
        here = self.candidates.present(now_s)
        systems = sorted({each.ids[0] for each in here})
        if len(systems) > 1:
            if self.problem is None:
                names = ", ".join(map(str, systems[:-1])) + f" and {systems[-1]}"
                self.problem = f"systems {names} are autopilots on this link: set vehicle.system_id"
            return
        if self._is_of_choice:
            self.problem = None
        if not here:
            return
        best = min(here, key=lambda each: (each.ids[1] != 1, each.ids[1]))
        if best is self.bound:
            return
        is_clear = self.wanted_system_id is not None and best.ids[1] == 1
        if is_clear or now_s - min(each.first_s for each in here) >= LISTEN_S:
            self._bind(best)

    @property
    def _is_of_choice(self) -> bool:
        """True if an id has to be configured, rather than frames doubted."""
        return self.problem is not None and self.problem.startswith("systems ")

    def _bind(self, candidate: Candidate) -> None:
        self.bound, self.peer, self.heard_s = candidate, candidate.peer, candidate.heard_s
        self.binds += 1
        self.problem = None
        self._course, self._exchange = IdentityCourse(), IdentityCourse()
        self.hardware = HardwareId()
        self._elsewhere.clear()
        self.unproved.clear()

    # The course of what is bound

    def _is_silent(self, now_s: float, silence_s: float | None = None) -> bool:
        least_s = self.silence_s if silence_s is None else silence_s
        return self.heard_s is None or self.candidates.listened_s(self.heard_s, now_s) >= least_s

    def _doubt(self, problem: str, now_s: float) -> None:
        self._doubted_s = now_s
        if self.problem is None or self._is_of_choice:
            self.problem = problem

    @property
    def _name(self) -> str:
        assert self.bound is not None
        return f"{self.bound.ids[0]}/{self.bound.ids[1]}"

    def _compare_kind(self, heartbeat: mavlink.MAVLink_heartbeat_message, now_s: float) -> None:
        """Check HEARTBEAT.type and autopilot, which never change while a vehicle is in use.

        Where one kind is heard again after another, two vehicles send.
        """
        bound = self.bound
        assert bound is not None
        kind = (autopilot_of(heartbeat) or Autopilot.OTHER, heartbeat.type)
        own, kinds_s = (bound.autopilot, bound.vehicle_type), self._kinds_s
        before_s, kinds_s[kind] = kinds_s.get(kind, -math.inf), now_s
        if kind == own:
            return
        is_return = now_s - min(before_s, kinds_s.get(own, -math.inf)) <= VANISHED_S
        if is_return or self.is_committed:
            now = f"{kind[0].value} {class_of(heartbeat).value}"
            was = f"{bound.autopilot.value} {bound.vehicle_class.value}"
            if is_return:
                self._doubt(f"two vehicles send as {self._name}: {was} and {now}", now_s)
                return
            change = now if now != was else f"type {kind[1]}, it was {bound.vehicle_type}"
            self._doubt(f"{self._name} is another vehicle now: {change}", now_s)
            return
        bound.autopilot, bound.vehicle_type = kind
        bound.vehicle_class = class_of(heartbeat)
        self._bind(bound)

    def _take_other_hardware(self, uid: str, now_s: float) -> None:
        """Process another hardware id: another vehicle, or one of two."""
        was = self.hardware.uid
        if now_s - self.hardware.heard_s <= VANISHED_S:
            self._doubt(f"two vehicles send as {self._name}: hardware {was} and {uid}", now_s)
            return
        self._doubt(f"{self._name} is another vehicle now: hardware {uid}, it was {was}", now_s)
        if not self.is_committed:
            self.hardware.uid = uid

    def _take_sign(self, sign: Sign, now_s: float) -> bool:
        """Follow the course by a sign; return True if its message is to be used."""
        match self._course.take(sign, now_s, is_cautious=not self.is_in_control):
            case SignVerdict.GOES_ON:
                return True
            case SignVerdict.WITHHELD:
                return False
            case SignVerdict.TWO:
                difference = self._course.difference
                self._doubt(f"two vehicles send as {self._name}: {difference}", now_s)
            case SignVerdict.ANOTHER:
                is_long = now_s - self._course.other_since_s >= LISTEN_S
                if is_long and not self.is_committed:
                    assert self.bound is not None
                    self._bind(self.bound)
                    return False
                difference = self._course.difference
                self._doubt(f"{self._name} is another vehicle now: {difference}", now_s)
        return False

    def _take_elsewhere(
        self, message: Message, sign: Sign | None, peer: Address | None, now_s: float
    ) -> bool:
        """Process a frame with our ids from another address; return True if that is ours now."""
        is_silent = self._is_silent(now_s)
        self.unknown_senders += not is_silent
        course = self._course_at(peer)
        if course is None:
            return False
        self._course.compare_beginning(course, message.get_seq(), sign, now_s)
        course.note_sequence(message.get_seq(), now_s)
        if sign is not None:
            course.take(sign, now_s)
        uid = uid_of(message)
        course.uid = uid or course.uid
        if uid is not None and self.hardware.uid not in (None, uid):
            self._doubt_elsewhere(f"hardware {uid}", peer, now_s, is_silent=is_silent)
            return False
        is_continuation = course.is_continuation and self._is_silent(now_s, SURE_SILENCE_S)
        if is_continuation or (is_silent and self._is_proof(course, sign, now_s)):
            self._move(peer, now_s)
            return self.problem is None
        if not is_silent:
            self._compare_senders(course, sign, peer, now_s)
        elif sign is None or self._is_possible(sign, now_s):
            self.unproved.setdefault(peer, -PROOF_PERIOD_S)
        elif course.is_steady:
            how = self._course.describe(sign, now_s)
            self._doubt(f"{self._name} at {_words(peer)} is another vehicle: {how}", now_s)
            is_gone = self.heard_s is not None and self.candidates.has_vanished(self.heard_s, now_s)
            if is_gone and not self.is_committed and self.bound is not None:
                self.bound.peer = peer
                self._bind(self.bound)
        return False

    def _doubt_elsewhere(
        self, how: str, peer: Address | None, now_s: float, *, is_silent: bool
    ) -> None:
        """Note another vehicle with our ids elsewhere; in control only if ours is silent."""
        if is_silent or not self.is_in_control:
            self._doubt(f"{self._name} at {_words(peer)} is another vehicle: {how}", now_s)

    def _course_at(self, peer: Address | None) -> IdentityCourse | None:
        course = self._elsewhere.get(peer)
        if course is None and len(self._elsewhere) < MAX_ADDRESSES:
            course = self._elsewhere[peer] = IdentityCourse()
        return course

    def _is_possible(self, sign: Sign, now_s: float) -> bool:
        """Return True if our vehicle, or its restart, may have sent a sign of another address."""
        if self._course.is_young(sign, now_s):
            return True
        is_clock = self.hardware.uid is not None or self._course.is_of_clock(sign, now_s)
        return is_clock and self._course.is_of_main(sign, now_s)

    def _is_proof(self, course: IdentityCourse, sign: Sign | None, now_s: float) -> bool:
        """Return True if a sign of another address shows our vehicle there, or its restart.

        Vehicles that are switched on together have nearly the same clock: a hardware id that is
        known has to be answered there, too.
        """
        if self._course.main is None or sign is None:
            return self._course.main is None
        is_its = self.hardware.uid is None or course.uid == self.hardware.uid
        return is_its and self._is_possible(sign, now_s)

    def _move(self, peer: Address | None, now_s: float) -> None:
        self.peer, self.heard_s = peer, now_s
        self.moves += 1
        self.hardware.ask_again()
        self._elsewhere.clear()
        self.unproved.clear()

    def _compare_senders(
        self, course: IdentityCourse, sign: Sign | None, peer: Address | None, now_s: float
    ) -> None:
        """Compare two addresses that both send: two vehicles if their courses differ.

        In control only our own is trusted: forged frames must not end a flight.
        """
        if self.is_in_control or sign is None or not course.is_steady:
            return
        if self._course.is_of_main(sign, now_s):
            return
        pair = f"{_words(self.peer)} and {_words(peer)}"
        text = f"two vehicles send as {self._name}, {pair}"
        self._doubt(f"{text}: {self._course.describe(sign, now_s)}", now_s)


def _words(peer: Address | None) -> str:
    return "the line" if peer is None else f"{peer[0]}:{peer[1]}"
