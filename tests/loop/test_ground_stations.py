"""Messages between the companion and a ground station on another link of the autopilot."""

from __future__ import annotations

import math
from functools import partial

import pytest

from companion.config.schema import CompanionConfig
from companion.domain import FlightMode
from companion.guidance.commands import ReportResult
from companion.guidance.phases import Phase
from companion.mav.codec import MavCodec
from companion.mav.dialect import MAVLink_target_estimate_message, Message, estimate_in, mavlink
from companion.mav.endpoint import Chunk
from companion.mav.payloads import TargetedTimesync, targets_of_frame
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from sim_link.lab.lockstep import Flight, Makers, MemoryJournal
from sim_link.lab.observer import frames_in
from tests.loop.loop_helpers import AUTO, of_system, run_until, said

FLAVOURS: tuple[FlavourName, ...] = ("px4", "ardupilot")
STATION = (255, 190)


class StationBehind(SimEndpoint):
    """A vehicle with a station on a second link."""

    def __init__(self, scenario: Scenario, seed: int, started_s: float) -> None:
        super().__init__(scenario, seed, started_s, links=2)
        self.heard = bytearray()
        self._station = MavCodec(*STATION)

    def take_output(self) -> list[Chunk]:
        chunks = super().take_output()
        for chunk in chunks:
            if chunk.link == 1:
                self.heard += chunk.data
        return [chunk for chunk in chunks if chunk.link == 0]

    def say(self, message: Message, now_s: float) -> None:
        """The station sends."""
        self.receive(Chunk(1, self._station.encode(message), None), now_s)


class WatchedFlight:
    """A flight and what its station heard of the companion."""

    def __init__(self, flavour: FlavourName, config: CompanionConfig = AUTO) -> None:
        scenario = Scenario(autopilot=AutopilotParams(flavour=flavour))
        self.notes = MemoryJournal()
        self.flight = Flight(
            of_system(config, 1), scenario, 1, self.notes, makers=Makers(simulator=StationBehind)
        )
        assert isinstance(self.flight.sim, StationBehind)
        self.sim = self.flight.sim
        self.run_until = partial(run_until, self.flight)
        self.say(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))

    def say(self, message: Message) -> None:
        self.sim.say(message, self.flight.now_s)

    def reposition(self, component: int, flags: float = 0.0) -> None:
        """The station sends the vehicle 30 m from where it is."""
        position = self.sim.vehicle.body.position_enu_m
        away = (position[0] + 30.0, position[1], position[2])
        latitude, longitude, altitude_m = self.sim.vehicle.origin.geodetic_from_enu(away)
        self.say(
            mavlink.MAVLink_command_int_message(
                *(1, component, mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_CMD_DO_REPOSITION, 0, 0),
                *(-1.0, flags, 0.0, math.nan),
                *(round(latitude * 1e7), round(longitude * 1e7), altitude_m),
            )
        )

    def frames(self) -> list[bytes]:
        """Return the companion's frames as the station received them."""
        return [f for f in frames_in(bytes(self.sim.heard)) if f[5] == 1 and f[6] == 191]

    def messages(self) -> list[Message]:
        reader = MavCodec(*STATION)
        return [m for frame in self.frames() for m in reader.decode(frame)]


def found(flavour: FlavourName) -> tuple[list[Message], ReportResult]:
    """Return the companion's messages at a station up to the report, and the report."""
    watched = WatchedFlight(flavour)
    watched.run_until(lambda: bool(watched.notes.results), 180.0)
    watched.flight.run(1.5)
    heard = watched.messages()
    assert not any(isinstance(m, MAVLink_target_estimate_message) for m in heard)
    return heard, watched.notes.results[-1][1]


@pytest.mark.slow
def test_the_estimate_reaches_a_station_through_ardupilot_in_a_tunnel() -> None:
    heard, result = found("ardupilot")
    estimates = [each for each in map(estimate_in, heard) if each is not None]
    assert len(estimates) >= 5
    last = estimates[-1]
    assert last.lat / 1e7 == pytest.approx(result.latitude_deg, abs=1e-6)
    assert last.lon / 1e7 == pytest.approx(result.longitude_deg, abs=1e-6)
    assert last.r95 == pytest.approx(result.estimate.r95_m, rel=0.2)
    assert (last.state, last.emitter_id) == (2, result.emitter_id)


@pytest.mark.slow
def test_the_estimate_and_its_covariance_reach_a_station_through_px4_in_named_values() -> None:
    heard, result = found("px4")
    assert [each for each in map(estimate_in, heard) if each is not None] == []
    values: dict[str, list[float]] = {}
    for message in heard:
        if isinstance(message, mavlink.MAVLink_named_value_float_message):
            values.setdefault(message.name, []).append(message.value)
    last = {name: series[-1] for name, series in values.items()}
    assert min(map(len, values.values())) >= 5
    east_m, north_m = result.estimate.position_enu_m
    (var_east, covariance), (_, var_north) = result.estimate.covariance_m2
    assert (last["TGT_EAST"], last["TGT_NORTH"]) == pytest.approx((east_m, north_m), abs=0.1)
    assert last["TGT_R95"] == pytest.approx(result.estimate.r95_m, rel=0.2)
    assert last["TGT_R95ABS"] == pytest.approx(result.estimate.absolute_r95_m, rel=0.2)
    matrix = [last[name] for name in ("TGT_VAR_E", "TGT_VAR_N", "TGT_COV_EN")]
    assert matrix == pytest.approx([var_east, var_north, covariance], rel=0.3, abs=1e-3)


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_no_question_for_the_time_reaches_a_station(flavour: FlavourName) -> None:
    watched = WatchedFlight(flavour)
    watched.flight.run(5.0)
    assert any(frame[7:10] == b"\0\0\0" for frame in watched.frames())  # its HEARTBEAT does
    kinds = {message.get_type() for message in watched.messages()}
    assert "TIMESYNC" not in kinds
    frame = MavCodec(1, 191).encode(TargetedTimesync(0, 5, 1, 1))
    assert targets_of_frame(frame) == (1, 1)


@pytest.mark.slow
@pytest.mark.parametrize("component", [0, 1])
def test_a_station_that_repositions_the_vehicle_is_announced_and_overruled(component: int) -> None:
    watched = WatchedFlight("ardupilot")
    flight = watched.flight
    run_until(flight, lambda: flight.companion.session.phase is Phase.NORMAL, 40.0)
    flight.run(4.0)
    for _ in range(4):  # the target is echoed only now and then before ours replaces it
        watched.reposition(component)
        flight.run(1.03)
    assert said(watched.notes, "another target was sent to the autopilot"), watched.notes.texts
    assert flight.mode is FlightMode.OFFBOARD
