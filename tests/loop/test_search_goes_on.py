"""After a report the search goes on for emitters that were not heard, and states it for them."""

from __future__ import annotations

import pytest

from companion.config.schema import (
    CompanionConfig,
    LimitsConfig,
    PatternConfig,
    PatternKind,
    PlannerConfig,
)
from companion.domain import FlightMode
from companion.guidance.commands import SessionParams
from companion.guidance.emitters import QueueParams
from companion.guidance.phases import Phase
from companion.search.detection_model import DetectionModel
from companion.search.searched_flight import SearchAreaParams, statement
from companion.view.snapshot import searched_text
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, PayloadParams, Scenario
from sim_link.world.environment import EmitterParams
from tests.loop.loop_helpers import Loop
from tools.campaign.checkpointing import Checkpointing

NEAREST = QueueParams(order="nearest")
FENCE = ((-5.0, -5.0), (245.0, -5.0), (245.0, 95.0), (-5.0, 95.0))
DETECTION = DetectionModel(reach_m=45.0, reach_sigma_db=3.0)
NEAR = EmitterParams(emitter_id=7, position_enu_m=(40.0, 30.0))
FAR = EmitterParams(emitter_id=3, position_enu_m=(210.0, 60.0))


def searching(
    search: PatternKind = "lawnmower",
    flavour: FlavourName = "px4",
    queue: QueueParams = NEAREST,
    others: tuple[EmitterParams, ...] = (FAR,),
    *,
    goes_on: bool = True,
    stop_pos: float | None = None,
) -> Loop:
    """A flight whose radio reaches 40 m: one emitter beside the start, the others far away."""
    config = CompanionConfig(
        mission=SessionParams(
            engage="auto", stop_confirm_s=2.0, stop_radius_m=2.0, searches_on=goes_on
        ),
        emitters=queue,
        limits=LimitsConfig(fence_enu_m=FENCE, speed_mps=8.0),
        planner=PlannerConfig(
            search=search, lost_after_s=8.0, pattern=PatternConfig(spacing_m=45.0)
        ),
        search=SearchAreaParams(detection=DETECTION, stop_pos=stop_pos, stop_sweeps=1),
    )
    scenario = Scenario(
        emitter=NEAR,
        emitters=others,
        payload=PayloadParams(max_range_m=45.0),
        autopilot=AutopilotParams(flavour=flavour),
    )
    return Loop(config, scenario)


def reported(loop: Loop) -> list[int | None]:
    return [result.emitter_id for _, result in loop.notes.results]


@pytest.mark.slow
@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
@pytest.mark.parametrize("search", ["lawnmower", "probability"])
def test_the_far_one_is_found_after_the_near_one(search: PatternKind, flavour: FlavourName) -> None:
    loop = searching(search, flavour, stop_pos=0.95 if search == "probability" else None)
    loop.run_until(lambda: len(loop.notes.results) == 2, 400.0)
    assert reported(loop) == [7, 3]
    assert loop.said("searching for further emitters")
    loop.run_until(lambda: loop.companion.session.is_search_over, 400.0)
    assert reported(loop) == [7, 3]
    why = "POS 95 % reached" if search == "probability" else "the area is done"
    assert loop.said(f"SEARCH OVER, no further emitter heard: {why}")
    assert loop.said("2 reported (emitters 3, 7); nothing heard of others. ")
    assert loop.phase is Phase.FINISHED
    assert loop.companion.session.result is not None


def test_what_was_searched_for_others_is_in_the_record_and_the_known_one_keeps_its_report() -> None:
    """Until the end the reported one is heard at times, and neither flown to nor reported again."""
    loop = searching(others=(), stop_pos=0.8)
    loop.run_until(lambda: bool(loop.notes.results), 120.0)
    session = loop.companion.session
    assert not session.has_found_all  # the memory of this mission is still needed
    accepted, reported_s = session.context.emitters.accepted, loop.now_s
    loop.run(1.0)
    assert (searched_text(session) or "").startswith("POS ")
    loop.run_until(lambda: session.is_search_over, 400.0)
    assert loop.now_s - reported_s > 20.0
    assert session.context.emitters.accepted > accepted
    assert reported(loop) == [7]
    assert session.status(loop.now_s).emitters[0].is_reported
    flight, state = session.searching.flight(0.0), session.searching.state
    assert flight is not None
    assert (flight.reported, flight.heard, flight.sought) == ((7,), (), ())
    assert flight.contact_unix_s is not None
    assert flight.ended_unix_s > flight.contact_unix_s
    assert state is not None
    assert state.pos >= 0.8
    text = statement(flight, state)
    assert text.startswith("1 reported (emitter 7); nothing heard of others. ")


def test_without_it_the_flight_ends_with_the_report() -> None:
    loop = searching(goes_on=False)
    loop.run_until(lambda: loop.phase is Phase.FINISHED, 120.0)
    assert reported(loop) == [7]
    assert loop.companion.session.has_found_all
    assert not loop.companion.session.searching.is_counting


@pytest.mark.slow
def test_contact_with_one_id_does_not_end_the_searched_area_of_another() -> None:
    loop = searching(queue=QueueParams(order="listed", listed=(7, 3)), others=(), goes_on=False)
    loop.run_until(lambda: loop.companion.session.is_search_over, 400.0)
    assert reported(loop) == [7]
    assert loop.said("SEARCH OVER, no further emitter heard: the area is done")
    assert loop.said("1 reported (emitter 7); nothing heard of emitter 3. ")
    flight = loop.companion.session.searching.flight(0.0)
    assert flight is not None
    assert flight.sought == (3,)


@pytest.mark.slow
def test_a_restart_reports_no_emitter_again() -> None:
    loop = searching(others=(), stop_pos=0.8)
    checkpointing = Checkpointing(loop.flight)
    loop.run_until(lambda: bool(loop.notes.results), 120.0)
    loop.run(6.0)  # a checkpoint is written
    assert checkpointing
    results = len(loop.notes.results)
    loop.flight.kill_companion()
    loop.run(5.0)
    loop.flight.start_companion()
    loop.choose(FlightMode.HOLD)
    loop.run_until(lambda: loop.phase is Phase.STANDBY, 20.0)
    loop.run(1.5)
    loop.choose(FlightMode.OFFBOARD)
    loop.run_until(lambda: loop.companion.session.is_search_over, 400.0)
    handed_over_again = reported(loop)[results:]
    assert handed_over_again == [7]  # the kept report, not a new one
    assert loop.notes.results[-1][1].estimate == loop.notes.results[0][1].estimate
    assert loop.said("1 reported (emitter 7); nothing heard of others. ")
