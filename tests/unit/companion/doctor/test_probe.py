"""The doctor on the simulated autopilots: it finds what is there, and changes nothing."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from companion.config.schema import CompanionConfig
from companion.doctor.autopilot_settings import RENAMED
from companion.doctor.examination import examine
from companion.doctor.findings import Facts, Level, LinkFacts
from companion.doctor.probe import TIMEOUT_S, DoctorProbe
from companion.domain import Autopilot
from companion.link.intake import Authenticity
from companion.mav.codec import MavCodec, message_id
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Chunk
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.scenario import AutopilotParams, Scenario
from tests.unit.companion.doctor.examples import HOST
from tests.unit.companion.mav.framing_helpers import unknown

PEER = ("127.0.0.1", 14580)
HARMLESS = {
    "HEARTBEAT",
    "TIMESYNC",
    "PARAM_REQUEST_READ",
    "COMMAND_LONG",
    "MISSION_REQUEST_LIST",
    "MISSION_REQUEST_INT",
    "MISSION_ACK",
}
HARMLESS_COMMANDS = {
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
    mavlink.MAV_CMD_REQUEST_MESSAGE,
}


class Practice:
    """A doctor and a vehicle on an ideal line, on invented time."""

    def __init__(self, flavour: str = "px4", seconds: float = 5.0, **options: int) -> None:
        scenario = Scenario(autopilot=AutopilotParams(flavour=flavour))  # type: ignore[arg-type]
        self.sim: SimEndpoint | None = SimEndpoint(scenario, 1)
        system_id = options.get("system_id")
        self.probe = DoctorProbe("udp", system_id, Authenticity(None, 0.0), seconds)
        self.sent: list[Message] = []
        self.now_s = 0.0
        self._reader = MavCodec(9, 9)
        self.alter: Callable[[bytes], bytes] = bytes
        """Changes what the vehicle sends."""

    def run(self) -> LinkFacts:
        while not self.probe.is_finished:
            assert self.now_s < 60.0
            self.now_s = round(self.now_s + 0.01, 6)
            if self.sim is not None and self.sim.next_timer_s() <= self.now_s:
                self.sim.handle_timer(self.now_s)
            if self.probe.next_timer_s() <= self.now_s:
                self.probe.handle_timer(self.now_s)
            self._carry()
        return self.probe.facts()

    def _carry(self) -> None:
        for chunk in self.probe.take_output():
            self.sent += self._reader.decode(chunk.data)
            if self.sim is not None:
                self.sim.receive(Chunk(0, chunk.data, PEER), self.now_s)
        if self.sim is not None:
            for chunk in self.sim.take_output():
                if chunk.peer in (None, PEER) and PEER not in chunk.except_peers:
                    self.probe.receive(Chunk(0, self.alter(chunk.data), PEER), self.now_s)


@pytest.fixture(scope="module", params=["px4", "ardupilot"])
def practice(request: pytest.FixtureRequest) -> Practice:
    practice = Practice(request.param)
    practice.run()
    return practice


def test_the_autopilot_is_recognised_and_heard_at_the_rates_asked_for(practice: Practice) -> None:
    autopilot = practice.probe.facts().autopilot
    assert autopilot is not None
    assert autopilot.autopilot in (Autopilot.PX4, Autopilot.ARDUPILOT)
    assert autopilot.system_id == 1
    assert not autopilot.is_armed
    assert autopilot.loss == 0.0
    by_name = {rate.name: rate for rate in autopilot.rates}
    assert by_name["LOCAL_POSITION_NED"].measured_hz == pytest.approx(20.0, rel=0.1)
    assert by_name["ATTITUDE"].measured_hz == pytest.approx(10.0, rel=0.1)
    is_px4 = autopilot.autopilot is Autopilot.PX4
    own, other = ("ESTIMATOR_STATUS", "EKF_STATUS_REPORT")[:: 1 if is_px4 else -1]
    assert by_name[own].measured_hz >= 4.5
    assert by_name[other].count == 0
    assert autopilot.missing == ()
    assert autopilot.origin is not None
    assert autopilot.origin.latitude_deg == pytest.approx(47.397742, abs=1e-6)


def test_messages_that_the_dialect_lacks_are_no_loss() -> None:
    practice = Practice()
    attitude = mavlink.MAVLINK_MSG_ID_ATTITUDE
    practice.alter = lambda data: unknown(data) if message_id(data) == attitude else data
    facts = practice.run().autopilot
    assert facts is not None
    assert {rate.count for rate in facts.rates if rate.name == "ATTITUDE"} == {0}
    assert facts.loss == 0.0


def test_every_parameter_is_reported_and_whole_numbers_are_whole(practice: Practice) -> None:
    autopilot = practice.probe.facts().autopilot
    assert autopilot is not None
    unreported = {name for name, value in autopilot.parameters.items() if value is None}
    assert unreported <= set(RENAMED.values())
    whole = {"COM_OBL_RC_ACT": 0, "SYSID_MYGCS": 255}
    for name, value in autopilot.parameters.items():
        if name in whole:
            assert isinstance(value, int)


def test_the_time_is_compared(practice: Practice) -> None:
    autopilot = practice.probe.facts().autopilot
    assert autopilot is not None
    assert autopilot.round_trip_s is not None
    assert autopilot.round_trip_s < 0.05
    assert autopilot.clock_offset_s is not None


def test_nothing_is_armed_switched_or_set(practice: Practice) -> None:
    assert {message.get_type() for message in practice.sent} <= HARMLESS
    for message in practice.sent:
        if isinstance(message, mavlink.MAVLink_command_long_message):
            assert message.command in HARMLESS_COMMANDS
    assert practice.sim is not None
    assert not practice.sim.vehicle.flavour.is_armed


def test_a_simulated_vehicle_on_the_ground_is_fit_to_fly(practice: Practice) -> None:
    facts = Facts(HOST, practice.probe.facts())
    failures = [f for f in examine(facts, CompanionConfig()) if f.level is Level.FAIL]
    assert failures == []


def test_an_empty_line_is_given_up_after_a_while() -> None:
    practice = Practice()
    practice.sim = None
    facts = practice.run()
    assert facts.autopilot is None
    assert facts.bytes_received == 0
    assert facts.waited_s == pytest.approx(TIMEOUT_S, abs=0.2)
    assert {message.get_type() for message in practice.sent} == {"HEARTBEAT"}


def test_another_vehicle_than_the_one_wanted_is_heard_and_not_examined() -> None:
    facts = Practice(system_id=7).run()
    assert facts.autopilot is None
    assert facts.other_autopilots == (1,)


def test_noise_is_counted() -> None:
    practice = Practice()
    practice.sim = None
    practice.probe.receive(Chunk(0, b"\x00\x01 not MAVLink", PEER), 0.0)
    assert practice.run().bytes_received == 14


def test_others_on_the_line_are_noticed() -> None:
    practice = Practice()
    companion = mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
    autopilot = mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3)
    practice.probe.receive(Chunk(0, MavCodec(1, 191).encode(companion), PEER), 0.0)
    practice.probe.receive(Chunk(0, MavCodec(255, 190).encode(companion), PEER), 0.0)
    practice.run()
    practice.probe.receive(Chunk(0, MavCodec(4, 1).encode(autopilot), PEER), practice.now_s)
    facts = practice.probe.facts()
    assert facts.other_companions == (1,)
    assert facts.other_autopilots == (4,)


def test_an_autopilot_that_does_not_tell_its_parameters_does_not_hold_up_the_doctor() -> None:
    practice = Practice(seconds=1.0)
    heard = practice.probe.receive

    def deaf(chunk: Chunk, now_s: float) -> None:
        messages = MavCodec(9, 9).decode(chunk.data)
        if not any(message.get_type() == "PARAM_VALUE" for message in messages):
            heard(chunk, now_s)

    practice.probe.receive = deaf  # type: ignore[method-assign]
    autopilot = practice.run().autopilot
    assert autopilot is not None
    assert set(autopilot.parameters.values()) == {None}
    assert practice.now_s < 8.0
