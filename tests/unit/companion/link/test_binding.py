"""Binding to an autopilot: candidates, listening, addresses."""

from __future__ import annotations

import pytest

from companion.domain import Autopilot
from companion.guidance.events import VehicleMark
from companion.link.binding import LISTEN_S, SURE_SILENCE_S, AutopilotBinding
from companion.link.candidates import VANISHED_S
from companion.link.identity import DOUBT_S
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from tests.unit.companion.link.wire import ARDUPILOT, NOBODY, PEER, PX4, STRANGER, heartbeat

NO_VEHICLES = """
GCS GIMBAL CAMERA ONBOARD_CONTROLLER ADSB ANTENNA_TRACKER FLARM ODID BATTERY WINCH CHARGING_STATION
PARACHUTE SERVO LOG OSD GPS
"""
TYPE = {name: getattr(mavlink, f"MAV_TYPE_{name}") for name in NO_VEHICLES.split()}
ANY_AUTOPILOT = (PX4, ARDUPILOT, NOBODY, mavlink.MAV_AUTOPILOT_GENERIC)


def from_system(message: Message, system: int = 1, component: int = 1) -> Message:
    (received,) = MavCodec(9, 9).decode(MavCodec(system, component).encode(message))
    return received


def component(kind: int, autopilot: int) -> Message:
    return mavlink.MAVLink_heartbeat_message(kind, autopilot, 0, 0, 4, 3)


ATTITUDE = from_system(mavlink.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 0))


def stamped(boot_s: float, system: int = 1) -> Message:
    return from_system(mavlink.MAVLink_attitude_message(round(1e3 * boot_s), *[0.0] * 6), system)


class Heard:
    """A binding and the heartbeats that it hears every second."""

    def __init__(self, wanted_system_id: int | None = None) -> None:
        self.binding = AutopilotBinding(wanted_system_id)
        self.now_s = 0.0
        self.is_in_control = False

    def hear(self, *ids: tuple[int, int], seconds: int = 1, autopilot: int = PX4) -> Heard:
        for _ in range(seconds):
            for system, number in ids:
                self.binding.recognise(
                    from_system(heartbeat(autopilot), system, number), PEER, self.now_s
                )
            self.now_s += 1.0
            self.binding.note_control(
                self.now_s, is_in_control=self.is_in_control, is_armed=self.is_in_control
            )
        return self

    @property
    def ids(self) -> tuple[int, int] | None:
        return None if self.binding.bound is None else self.binding.bound.ids


def bound() -> AutopilotBinding:
    binding = AutopilotBinding(wanted_system_id=1)
    assert binding.recognise(from_system(heartbeat()), PEER, 10.0)
    return binding


@pytest.mark.parametrize("kind", TYPE.values(), ids=TYPE)
@pytest.mark.parametrize("autopilot", ANY_AUTOPILOT)
def test_what_flies_nothing_does_not_bind_whatever_its_autopilot(kind: int, autopilot: int) -> None:
    binding = AutopilotBinding()
    for second in range(20):
        for ids in ((1, 154), (1, 1), (255, 190)):
            message = from_system(component(kind, autopilot), *ids)
            assert not binding.recognise(message, PEER, float(second))
    assert not binding.is_bound


@pytest.mark.parametrize("kind", range(50))
@pytest.mark.parametrize("autopilot", [NOBODY, mavlink.MAV_AUTOPILOT_GENERIC])
def test_no_autopilot_and_the_generic_one_do_not_bind(kind: int, autopilot: int) -> None:
    binding = AutopilotBinding(wanted_system_id=1)
    for second in range(8):
        binding.recognise(from_system(component(kind, autopilot)), PEER, float(second))
    assert not binding.is_bound


def test_a_gimbal_before_the_autopilot_is_named_and_the_autopilot_bound() -> None:
    heard = Heard()
    gimbal = from_system(component(TYPE["GIMBAL"], 0), 1, 154)
    heard.binding.recognise(gimbal, PEER, 0.0)
    heard.now_s = 1.5
    assert heard.hear((1, 1), seconds=4).ids == (1, 1)
    assert heard.binding.candidates.non_autopilot_names() == ["1/154 (gimbal)"]


def test_nothing_but_a_heartbeat_binds() -> None:
    binding = AutopilotBinding()
    assert not binding.recognise(ATTITUDE, PEER, 0.0)
    assert not binding.is_bound


@pytest.mark.parametrize(
    ("number", "kind"),
    [(PX4, Autopilot.PX4), (ARDUPILOT, Autopilot.ARDUPILOT), (4, Autopilot.OTHER)],
)
def test_the_only_autopilot_is_bound_once_others_had_time_to_speak(
    number: int, kind: Autopilot
) -> None:
    heard = Heard().hear((4, 1), seconds=int(LISTEN_S) - 1, autopilot=number)
    assert heard.ids is None
    heard.hear((4, 1), seconds=2, autopilot=number)
    assert heard.ids == (4, 1)
    assert (heard.binding.autopilot, heard.binding.peer) == (kind, PEER)


@pytest.mark.parametrize("first", [1, 2])
def test_two_systems_are_waited_for_and_named(first: int) -> None:
    heard = Heard().hear((first, 1)).hear((1, 1), (2, 1), seconds=30)
    assert heard.ids is None
    expected = "systems 1 and 2 are autopilots on this link: set vehicle.system_id"
    assert heard.binding.problem == expected


def test_when_one_of_two_vanishes_the_other_is_bound() -> None:
    heard = Heard().hear((1, 1), (2, 1), seconds=5).hear((2, 1), seconds=int(VANISHED_S) + 2)
    assert heard.ids == (2, 1)
    assert heard.binding.problem is None


def test_one_that_vanished_is_no_other_on_this_link() -> None:
    heard = Heard().hear((1, 1), (2, 1), seconds=5).hear((1, 1), seconds=20)
    assert (heard.ids, heard.binding.others) == ((1, 1), [])


def test_one_that_comes_later_makes_it_wait_again() -> None:
    heard = Heard().hear((2, 1), seconds=20).hear((1, 1), (2, 1))
    assert heard.ids == (2, 1)
    assert heard.binding.problem is not None


def test_one_that_comes_in_control_changes_nothing() -> None:
    heard = Heard().hear((2, 1), seconds=5)
    heard.is_in_control = True
    heard.hear((2, 1)).hear((1, 1), (2, 1), seconds=30)
    assert heard.ids == (2, 1)
    assert heard.binding.problem is None
    assert heard.binding.others == [1]


def test_what_vanished_is_replaced_while_not_in_control() -> None:
    heard = Heard().hear((2, 1), seconds=5).hear((1, 1), seconds=int(VANISHED_S) + 2)
    assert heard.ids == (1, 1)
    assert heard.binding.binds == 2


def test_what_vanished_in_control_is_not_replaced() -> None:
    heard = Heard().hear((2, 1), seconds=5)
    heard.is_in_control = True
    heard.hear((2, 1)).hear((1, 1), seconds=60)
    assert heard.ids == (2, 1)


@pytest.mark.parametrize("wanted", [None, 1])
def test_component_1_is_preferred_and_taken_up_later(wanted: int | None) -> None:
    together = Heard(wanted).hear((1, 2)).hear((1, 1), (1, 2), seconds=6)
    assert together.ids == (1, 1)
    late = Heard(wanted).hear((1, 2), seconds=6)
    assert late.ids == (1, 2)
    assert late.hear((1, 2), (1, 1), seconds=4).ids == (1, 1)


def test_only_the_wanted_system_binds_and_at_once() -> None:
    heard = Heard(wanted_system_id=3).hear((1, 1), (2, 1), seconds=5)
    assert heard.ids is None
    assert heard.hear((3, 1)).ids == (3, 1)
    assert heard.binding.problem is None


def test_the_systems_of_others_are_no_concern_of_a_configured_one() -> None:
    heard = Heard(wanted_system_id=3).hear((3, 1), (1, 1), seconds=5)
    assert (heard.binding.problem, heard.binding.others) == (None, [])


@pytest.mark.parametrize("silence_s", [0.1, 2.9, 3.0])
def test_an_address_is_taken_over_only_after_silence(silence_s: float) -> None:
    binding = bound()
    is_believed = silence_s >= 3.0
    assert binding.recognise(ATTITUDE, STRANGER, 10.0 + silence_s) == is_believed
    assert binding.peer == (STRANGER if is_believed else PEER)
    assert binding.unknown_senders == (0 if is_believed else 1)


def position_report(boot_s: float, sequence: int, north_m: float = 5.0) -> Message:
    message = mavlink.MAVLink_local_position_ned_message(round(1e3 * boot_s), north_m, *[0.0] * 5)
    codec = MavCodec(1, 1)
    for _ in range(sequence + 1):
        data = codec.encode(message)
    (received,) = MavCodec(9, 9).decode(data)
    return received


class TestAnotherAddress:
    """Ours was heard until 10 s, at 100 s of its clock, with sequence number 20."""

    @pytest.fixture
    def binding(self) -> AutopilotBinding:
        binding = AutopilotBinding(wanted_system_id=1)
        binding.recognise(from_system(heartbeat()), PEER, 8.9)
        for tenth in range(11):
            binding.recognise(
                position_report(99.0 + 0.1 * tenth, 10 + tenth), PEER, 9.0 + 0.1 * tenth
            )
        return binding

    def moved_s(
        self, binding: AutopilotBinding, *, off_s: float, first: int, north_m: float
    ) -> float | None:
        """Return when it moved, within a second of frames at another address; None: never."""
        for tenth in range(1, 10):
            boot_s, now_s = 100.0 + off_s + 0.1 * tenth, 10.0 + 0.1 * tenth
            binding.recognise(position_report(boot_s, first + tenth, north_m), STRANGER, now_s)
            if binding.peer == STRANGER:
                return now_s
        return None

    def test_another_port_of_a_nat_is_taken_before_px4_leaves_offboard(
        self, binding: AutopilotBinding
    ) -> None:
        moved_s = self.moved_s(binding, off_s=0.0, first=20, north_m=5.5)
        assert moved_s == pytest.approx(10.0 + SURE_SILENCE_S, abs=0.11)

    @pytest.mark.parametrize(
        ("off_s", "first", "north_m"), [(0.0, 90, 5.0), (0.0, 20, 15.0), (1.5, 20, 5.0)]
    )
    def test_another_sequence_place_or_clock_is_not(
        self, binding: AutopilotBinding, off_s: float, first: int, north_m: float
    ) -> None:
        assert self.moved_s(binding, off_s=off_s, first=first, north_m=north_m) is None

    @pytest.mark.parametrize(("off_s", "is_ours"), [(0.5, True), (1.5, False), (-1.5, False)])
    def test_without_a_hardware_id_its_clock_has_to_be_the_same(
        self, binding: AutopilotBinding, off_s: float, is_ours: bool
    ) -> None:
        for tenth in range(60):
            boot_s, now_s = 100.0 + off_s + 0.1 * tenth, 10.0 + 0.1 * tenth
            binding.recognise(position_report(boot_s, 90 + tenth, 9.0), STRANGER, now_s)
        assert (binding.peer == STRANGER) is is_ours
        assert (binding.problem is None) is is_ours

    @pytest.mark.parametrize(("answered", "is_ours"), [(7, True), (8, False), (0, False)])
    def test_a_hardware_id_that_is_known_has_to_be_answered(
        self, binding: AutopilotBinding, answered: int, is_ours: bool
    ) -> None:
        binding.recognise(version(7), PEER, 10.0)
        for tenth in range(60):
            now_s = 10.0 + 0.1 * tenth
            binding.recognise(position_report(90.0 + now_s, 90 + tenth, 9.0), STRANGER, now_s)
            if binding.take_unproved(now_s) and answered:
                binding.recognise(version(answered), STRANGER, now_s)
        assert (binding.peer == STRANGER) is is_ours


def version(uid: int) -> Message:
    nothing = [0] * 8
    return from_system(
        mavlink.MAVLink_autopilot_version_message(
            0, 0, 0, 0, 0, nothing, nothing, nothing, 0, 0, uid, [0] * 18
        )
    )


def test_where_the_sequence_breaks_the_hardware_id_is_asked_for_again() -> None:
    """A twin behind our address that was switched on with ours has its clock and position."""
    binding = AutopilotBinding(wanted_system_id=1)
    binding.recognise(from_system(heartbeat()), PEER, 9.0)
    binding.recognise(version(7), PEER, 9.1)
    for tenth in range(50):
        binding.recognise(position_report(99.0 + 0.1 * tenth, 10 + tenth), PEER, 9.0 + 0.1 * tenth)
    assert not binding.hardware.is_due(14.0)
    binding.recognise(position_report(104.0, 200), PEER, 14.0)
    assert binding.hardware.is_due(14.0)
    binding.recognise(version(8), PEER, 14.1)
    assert binding.problem is not None


@pytest.mark.parametrize("kind", [mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_TYPE_GIMBAL])
def test_a_heartbeat_of_what_is_no_autopilot_is_ignored_under_its_ids(kind: int) -> None:
    """A router's own heartbeat with the ids 1/1 kept the vehicle from being ready, in silence."""
    heard = Heard().hear((1, 1), seconds=5)
    binds = heard.binding.binds
    for is_in_control in (False, True):
        heard.is_in_control = is_in_control
        heard.hear((1, 1))
        assert not heard.binding.recognise(from_system(component(kind, NOBODY)), PEER, heard.now_s)
    heard.hear((1, 1))
    assert (heard.binding.binds, heard.binding.problem) == (binds, None)


def test_a_stranger_does_not_keep_the_link_alive() -> None:
    binding = bound()
    binding.recognise(ATTITUDE, STRANGER, 12.0)
    assert binding.heard_s == 10.0


@pytest.mark.parametrize("stall_s", [4.0, 30.0])
def test_a_stall_of_the_companion_is_no_silence_of_its_autopilot(stall_s: float) -> None:
    """Frames of another address with an old stamp, sent during the stall, are read first."""
    heard = Heard().hear((1, 1), seconds=5)
    heard.is_in_control = True
    for _ in range(4):
        heard.hear((1, 1))
        heard.binding.recognise(stamped(100.0 + heard.now_s), PEER, heard.now_s)
        heard.binding.recognise(stamped(50.0 + heard.now_s), STRANGER, heard.now_s)
    binding, resumed_s = heard.binding, heard.now_s + stall_s
    assert not binding.recognise(stamped(50.0 + heard.now_s), STRANGER, resumed_s)
    assert binding.recognise(stamped(100.0 + resumed_s), PEER, resumed_s)
    binding.note_control(resumed_s, is_in_control=True, is_armed=True)
    assert binding.problem is None
    assert binding.peer == PEER


@pytest.mark.parametrize("stall_s", [11.0, 30.0])
def test_after_a_stall_on_the_ground_the_autopilot_is_still_there(stall_s: float) -> None:
    heard = Heard().hear((1, 1), seconds=5)
    heard.hear((1, 1), (2, 1))
    assert heard.ids == (1, 1)
    heard.now_s += stall_s
    heard.binding.recognise(from_system(heartbeat(), 2, 1), PEER, heard.now_s)
    assert heard.ids == (1, 1)
    assert heard.binding.problem is not None


KNOWN = VehicleMark(1, 1, "a1", 500.0)
"""Identity of a vehicle whose boot clock shows 500 s when the next process begins."""


class TestARestartInFlight:
    @pytest.mark.parametrize("off_s", [-0.8, 0.0, 0.8])
    def test_the_vehicle_of_before_is_bound_at_the_first_sign_of_it(self, off_s: float) -> None:
        binding = AutopilotBinding()
        binding.expect(KNOWN, 2.0)
        for message in (heartbeat(), stamped(500.6 + off_s)):
            assert not binding.is_bound
            binding.recognise(from_system(message), PEER, 2.6)
        assert binding.is_bound
        assert binding.hardware.uid == "a1"

    @pytest.mark.parametrize(
        ("boot_s", "system", "peer"),
        [
            (0.4, 1, PEER),
            (490.0, 1, PEER),
            (503.0, 1, PEER),
            (500.6, 2, PEER),
            (500.6, 1, STRANGER),
        ],
        ids=["restarted", "behind", "ahead", "another id", "another address"],
    )
    def test_any_other_is_listened_for(
        self, boot_s: float, system: int, peer: tuple[str, int]
    ) -> None:
        binding = AutopilotBinding()
        binding.expect(KNOWN, 2.0)
        binding.recognise(from_system(heartbeat(), system), PEER, 2.6)
        binding.recognise(stamped(boot_s, system), peer, 2.6)
        assert not binding.is_bound
        binding.note_control(2.7 + LISTEN_S, is_in_control=False, is_armed=False)
        assert binding.is_bound
        assert binding.hardware.uid is None

    def test_no_sign_alone_binds(self) -> None:
        binding = AutopilotBinding()
        binding.expect(KNOWN, 2.0)
        assert not binding.recognise(stamped(500.6), PEER, 2.6)
        assert not binding.is_bound

    def test_a_neighbour_does_not_keep_it_from_being_bound(self) -> None:
        binding = AutopilotBinding()
        binding.expect(KNOWN, 2.0)
        for system in (2, 1):
            binding.recognise(from_system(heartbeat(), system), STRANGER, 2.5)
        binding.recognise(stamped(500.6), STRANGER, 2.6)
        assert binding.system_id == 1
        binding.note_control(2.6, is_in_control=False, is_armed=False)
        assert binding.problem is not None  # with two there is no control without a configured id

    def test_the_mark_of_a_bound_vehicle_goes_on_as_its_clock(self) -> None:
        binding = bound()
        assert binding.mark(10.0) is None
        for tick in range(30):
            binding.recognise(stamped(500.0 + 0.1 * tick), PEER, 10.0 + 0.1 * tick)
        mark = binding.mark(20.0)
        assert mark is not None
        assert (mark.system_id, mark.component_id, mark.uid) == (1, 1, None)
        assert mark.boot_s == pytest.approx(510.0, abs=0.01)


@pytest.mark.parametrize("stays", [mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_TYPE_GROUND_ROVER])
def test_two_kinds_under_one_id_are_two_vehicles_until_one_has_gone(stays: int) -> None:
    """A rover as 1/1 beside our copter: each heartbeat bound the other one, and cleared doubt."""
    kinds, heard = (mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_TYPE_GROUND_ROVER), Heard()
    binding = heard.hear((1, 1), seconds=5, autopilot=ARDUPILOT).binding

    def hear(*kinds: int, seconds: int) -> None:
        for _ in range(2 * seconds):
            for kind in kinds:
                binding.recognise(from_system(component(kind, ARDUPILOT)), PEER, heard.now_s)
            heard.now_s += 0.5
            binding.note_control(heard.now_s, is_in_control=False, is_armed=False)

    hear(*kinds, seconds=2)
    binds = binding.binds
    for _ in range(20):
        hear(*kinds, seconds=1)
        assert binding.problem is not None
        assert binding.problem.startswith("two vehicles send as 1/1: ArduPilot ")
    assert binding.binds == binds
    hear(stays, seconds=int(VANISHED_S + DOUBT_S) + 2)
    assert binding.problem is None
    assert binding.bound is not None
    assert binding.bound.vehicle_type == stays
