"""Companion and vehicle with a key, in lockstep: a flight, a stranger, a recording."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import pytest

from companion.config.schema import CompanionConfig
from companion.flight_setup import build_endpoint
from companion.guidance.phases import Phase
from companion.link.endpoint import CompanionEndpoint
from companion.link.interface import Journal, LinkSpec
from companion.mav.endpoint import Chunk
from companion.mav.signing import ONE_LINK_EACH, Signing, SigningKey, is_signed
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.protocols.link_layer import LinkSecurity
from sim_link.autopilot.scenario import Scenario
from sim_link.lab.lockstep import VEHICLE_PEER, Flight, Makers, MemoryJournal
from sim_link.lab.observer import Frame, Observer
from tests.loop.loop_helpers import AUTO, run_until

KEY = SigningKey(bytes(range(1, 33)))
UNIX_S = 1_800_000_000.0


class Tape(Observer):
    """Record of the vehicle's frames, and of unsigned frames of the companion."""

    def __init__(self) -> None:
        self.vehicle: list[bytes] = []
        self.unsigned = 0

    def sent(self, frame: Frame) -> None:
        self.unsigned += not is_signed(frame.data)

    def vehicle_sent(self, frame: Frame) -> None:
        self.unsigned += not is_signed(frame.data)
        self.vehicle.append(frame.data)


def vehicle(scenario: Scenario, seed: int, started_s: float) -> SimEndpoint:
    return SimEndpoint(
        scenario,
        seed,
        started_s,
        security=LinkSecurity(Signing(KEY), started_unix_s=UNIX_S + started_s),
    )


def companion(
    config: CompanionConfig, journal: Journal, links: Sequence[LinkSpec], key: SigningKey
) -> CompanionEndpoint:
    signing = Signing(key, rules=ONE_LINK_EACH)
    return build_endpoint(config, journal, links, signing=signing, started_unix_s=UNIX_S)


def flight(key: SigningKey = KEY) -> tuple[Flight, MemoryJournal, Tape]:
    notes, tape = MemoryJournal(), Tape()
    make = partial(companion, key=key)
    made = Flight(AUTO, Scenario(), 1, notes, makers=Makers(make, vehicle))
    made.observers.append(tape)
    return made, notes, tape


def test_with_one_key_on_both_sides_the_target_is_searched_and_every_frame_is_signed() -> None:
    made, _, tape = flight()
    run_until(made, lambda: made.companion.session.phase is Phase.NORMAL, 60.0)
    made.run(5.0)
    assert made.companion.session.phase is Phase.NORMAL
    assert len(tape.vehicle) > 500
    assert tape.unsigned == 0


def test_with_another_key_the_vehicle_is_a_stranger() -> None:
    made, notes, _ = flight(SigningKey(bytes(range(2, 34))))
    made.run(12.0)
    assert not made.companion.binding.is_bound
    assert any("bad signature (is it the same key on both sides?)" in t for _, t in notes.texts)


@pytest.fixture(scope="module")
def recorded_flight() -> tuple[Flight, list[bytes]]:
    """Return a flight in control, and the last frames of its vehicle."""
    made, _, tape = flight()
    run_until(made, lambda: made.companion.session.phase is Phase.NORMAL, 60.0)
    return made, tape.vehicle[-1500:]


@pytest.mark.parametrize("order", ["as it was", "backwards", "twice"])
def test_a_recording_of_the_flight_changes_nothing_in_any_order(
    order: str, recorded_flight: tuple[Flight, list[bytes]]
) -> None:
    made, recorded = recorded_flight
    replayed = {
        "as it was": recorded,
        "backwards": recorded[::-1],
        "twice": [frame for frame in recorded for _ in range(2)],
    }[order]
    session = made.companion.session
    before = (session.phase, session.vehicle.heartbeat, session.vehicle.position_enu_m)
    accepted = session.tracker.accepted
    for frame in replayed:
        made.companion.receive(Chunk(0, frame, VEHICLE_PEER), made.now_s)
    after = (session.phase, session.vehicle.heartbeat, session.vehicle.position_enu_m)
    assert after == before
    assert session.tracker.accepted == accepted
