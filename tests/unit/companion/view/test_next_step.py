"""At every moment of a flight the operator reads what to do, in a few plain words."""

from __future__ import annotations

from dataclasses import replace

import pytest

from companion.domain import EstimateState, FlightMode
from companion.guidance.handover import GRANT_HOW
from companion.guidance.phases import PHASE_NAMES, Phase
from companion.guidance.session import GuidanceStatus
from companion.view.snapshot import next_step
from tests.loop.loop_helpers import Loop

MAX_WORDS = 20
"""Maximum number of words in a text; a longer one is not read in flight."""


@pytest.fixture(scope="module")
def flown() -> Loop:
    loop = Loop(seed=1)
    loop.run(30.0)
    return loop


def hint(loop: Loop, **changes: object) -> str:
    return next_step(loop.companion, status_of(loop, **changes))


def status_of(loop: Loop, **changes: object) -> GuidanceStatus:
    return replace(loop.companion.session.status(loop.now_s), **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("phase", Phase)
def test_every_phase_has_a_short_sentence_of_its_own(flown: Loop, phase: Phase) -> None:
    text = hint(flown, phase=phase, detail="")
    assert text.endswith(".")
    assert len(text.split()) <= MAX_WORDS
    others = {hint(flown, phase=each, detail="") for each in Phase if each is not phase}
    assert text not in others


def test_before_anything_is_heard_it_says_what_to_switch_on() -> None:
    assert hint(Loop(seed=1)).startswith("Switch the autopilot on.")


def test_the_end_of_a_search_does_not_claim_that_an_emitter_was_found(flown: Loop) -> None:
    assert "found" not in PHASE_NAMES[Phase.FINISHED]
    assert hint(flown, phase=Phase.FINISHED).startswith("Read the result.")


def test_a_lost_link_comes_before_the_phase(flown: Loop) -> None:
    assert "failsafe" in hint(flown, is_link_lost=True)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"estimate": None}, "search for the emitter"),
        ({"phase": Phase.HOLD, "detail": "operator requested hold"}, "Press RESUME"),
        ({"phase": Phase.HOLD, "detail": "no ranging for 5 s"}, "Check the radio"),
        ({"phase": Phase.WAITING, "detail": "found in OFFBOARD"}, "Switch to another mode"),
    ],
)
def test_it_goes_by_what_is_known(flown: Loop, changes: dict[str, object], words: str) -> None:
    assert words in hint(flown, **{"phase": Phase.NORMAL, **changes})


@pytest.mark.parametrize("state", EstimateState)
def test_a_search_is_reported_by_the_state_of_its_estimate(
    flown: Loop, state: EstimateState
) -> None:
    estimate = flown.companion.session.estimate
    assert estimate is not None
    hint_now = hint(flown, phase=Phase.NORMAL, estimate=replace(estimate, state=state))
    assert ("two positions" in hint_now) is (state is EstimateState.AMBIGUOUS)
    assert ("report" in hint_now) is (state is EstimateState.LOCALISED)


def test_after_a_launched_flight_was_taken_over_it_is_not_about_to_take_off() -> None:
    loop = Loop(seed=1)
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 30.0)
    loop.choose(FlightMode.HOLD)
    loop.run_until(lambda: loop.phase is Phase.YIELD, 2.0)
    assert "stay in another mode until ready" in hint(loop)
    loop.run_until(lambda: loop.phase is Phase.STANDBY, 5.0)
    assert hint(loop).startswith("Switch to offboard mode to hand over control.")


def test_where_a_grant_is_needed_it_says_how(flown: Loop) -> None:
    flown.companion.session.authority.require_grant("failsafe")
    text = hint(flown, phase=Phase.YIELD)
    assert GRANT_HOW in text
    assert len(text.split()) <= MAX_WORDS
