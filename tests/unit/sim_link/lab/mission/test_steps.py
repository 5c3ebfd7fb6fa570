"""Flying a script step by step, against a situation that is made up."""

from __future__ import annotations

import pytest

from companion.domain import FlightMode
from sim_link.lab.faults.fault_models import Fault, LinkBlackout
from sim_link.lab.mission.results import FlightRecord
from sim_link.lab.mission.script import STEP_KINDS
from sim_link.lab.mission.script_file import parse_mission
from sim_link.lab.mission.steps import (
    ASK_AGAIN_S,
    Action,
    Request,
    StepRunner,
    TakeOffAction,
)


class Crew:
    """Operator and harness that only take notes."""

    def __init__(self) -> None:
        self.asked: list[Action] = []
        self.injected: list[tuple[Fault, float]] = []
        self.refusal: str | None = None

    def ask(self, action: Action) -> None:
        self.asked.append(action)

    def take_refusal(self) -> str | None:
        return self.refusal

    def inject(self, fault: Fault, now_s: float) -> None:
        self.injected.append((fault, now_s))


class Flown:
    """A script with everything around it."""

    def __init__(self, steps: str, more: str = "") -> None:
        self.mission = parse_mission(f"name: m\n{more}\nsteps: {steps}\n", "m")
        self.record, self.crew = FlightRecord(), Crew()
        self.situation = self.record.situation
        self.runner = StepRunner(self.mission, self.record, self.crew, self.crew.inject)

    def tick(self, now_s: float) -> None:
        self.runner.tick(now_s)

    @property
    def done(self) -> list[str]:
        return [step.name for step in self.record.steps if not step.failure]


def test_steps_are_flown_in_order_and_each_asks_for_what_it_needs() -> None:
    flown = Flown("[connect, wait_ready, arm, takeoff, engage, return]")
    vehicle, companion = flown.situation.vehicle, flown.situation.companion
    flown.tick(0.0)
    assert flown.crew.asked == []
    vehicle.mode, companion.phase = "hold", "standby"
    flown.tick(1.0)
    assert flown.done == ["connect"]
    vehicle.is_ready = True
    flown.tick(2.0)
    assert flown.crew.asked == [Request.ARM]
    vehicle.is_armed = True
    flown.tick(3.0)
    assert flown.crew.asked[-1:] == [TakeOffAction(20.0)]
    vehicle.height_m = 19.6
    flown.tick(9.0)
    assert flown.crew.asked[-1:] == [FlightMode.OFFBOARD]
    companion.is_in_control = True
    flown.tick(10.0)
    assert flown.crew.asked[-1:] == [FlightMode.RETURN]
    assert not flown.runner.is_over
    vehicle.is_armed = False
    flown.tick(40.0)
    assert flown.runner.is_over
    assert flown.runner.failure == ""
    assert [step.ended_s for step in flown.record.steps] == [1.0, 2.0, 3.0, 9.0, 10.0, 40.0]


def test_an_autopilot_that_does_not_react_is_asked_again() -> None:
    flown = Flown("[arm]")
    for tick in range(45):
        flown.tick(tick / 10)
    assert flown.crew.asked == [Request.ARM] * 3
    assert ASK_AGAIN_S == 2.0


def test_a_takeoff_that_has_begun_is_not_asked_for_again() -> None:
    flown = Flown("[takeoff]")
    flown.tick(0.0)
    flown.situation.vehicle.height_m = 1.0
    flown.tick(10.0)
    assert flown.crew.asked == [TakeOffAction(20.0)]


def test_a_step_that_takes_too_long_ends_the_mission_and_says_why() -> None:
    flown = Flown("[{arm: {limit_s: 5}}, land]")
    flown.crew.refusal = "not ready"
    flown.tick(0.0)
    flown.tick(4.9)
    assert not flown.runner.is_over
    flown.tick(5.0)
    assert flown.runner.is_over
    assert flown.runner.failure == "step 1 arm: arming did not happen within 5 s (not ready)"
    assert flown.done == []


def test_the_missions_own_limit_ends_a_step_that_may_wait_for_ever() -> None:
    flown = Flown("[{wait: {for_s: 1000}}]", "time_limit_s: 30")
    flown.tick(0.0)
    flown.tick(30.0)
    assert flown.runner.failure == "step 1 wait: the mission's time limit of 30 s"


def test_a_condition_must_hold_without_a_break() -> None:
    flown = Flown("[{wait_until: {condition: estimate.r95_m < 1, limit_s: 60, for_s: 2}}]")
    flown.tick(0.0)
    flown.situation.estimate.r95_m = 0.5
    flown.tick(1.0)
    flown.tick(2.9)
    flown.situation.estimate.r95_m = 1.5
    flown.tick(2.95)
    flown.situation.estimate.r95_m = 0.5
    flown.tick(3.0)
    flown.tick(4.9)
    assert flown.done == []
    flown.tick(5.0)
    assert flown.done == ["wait_until"]


def test_a_condition_that_began_to_hold_in_time_may_last_beyond_the_limit() -> None:
    flown = Flown("[{hold: {for_s: 30, limit_s: 5}}]")
    flown.tick(0.0)
    flown.situation.vehicle.mode = "hold"
    flown.tick(4.0)
    flown.tick(33.0)
    assert not flown.runner.is_over
    flown.tick(34.0)
    assert flown.done == ["hold"]


def test_a_pilots_override_is_over_when_the_companion_has_yielded() -> None:
    flown = Flown("[{pilot_override: {mode: position}}, grant]")
    vehicle, companion = flown.situation.vehicle, flown.situation.companion
    vehicle.mode, companion.is_in_control = "offboard", True
    flown.tick(0.0)
    vehicle.mode = "position"
    flown.tick(3.0)
    assert flown.done == []
    assert flown.crew.asked == [FlightMode.POSITION]
    companion.is_in_control, companion.phase = False, "yield"
    flown.tick(3.1)
    assert flown.crew.asked[-1:] == [Request.GRANT]
    companion.phase = "standby"
    flown.tick(3.2)
    assert flown.done == ["pilot_override", "grant"]


def test_a_grant_is_over_though_the_autopilot_gave_the_mode_back_at_once() -> None:
    flown = Flown("[grant]")
    companion = flown.situation.companion
    companion.is_in_control, companion.phase = False, "yield"
    flown.tick(0.0)
    assert flown.crew.asked == [Request.GRANT]
    assert flown.done == []
    companion.is_in_control, companion.phase = True, "normal"
    flown.tick(0.1)
    assert flown.done == ["grant"]


def test_a_search_is_over_with_contact_or_with_the_report() -> None:
    for until, contact_is_enough in (("contact", True), ("reported", False)):
        flown = Flown(f"[{{search: {{until: {until}}}}}]")
        flown.situation.companion.waypoint = "search"
        flown.tick(0.0)
        assert not flown.runner.is_over
        flown.situation.estimate.r95_m = 30.0
        flown.situation.companion.waypoint = "crossing"
        flown.tick(1.0)
        assert flown.runner.is_over is contact_is_enough
        flown.situation.companion.reported = 1
        flown.tick(2.0)
        assert flown.runner.is_over


def test_a_fault_is_injected_and_the_mission_goes_on_at_once() -> None:
    flown = Flown("[{inject: {kind: link_blackout, duration_s: 3}}, {wait: {for_s: 1}}]")
    flown.tick(7.0)
    assert flown.crew.injected == [(LinkBlackout(duration_s=3.0), 7.0)]
    assert flown.done == ["inject"]
    flown.tick(8.0)
    assert flown.runner.is_over


def test_an_always_is_watched_from_the_first_step_to_the_last() -> None:
    flown = Flown(
        "[{wait: {for_s: 10}}]",
        "expectations: [{name: low, always: vehicle.height_m < 40}]",
    )
    flown.tick(0.0)
    assert flown.record.breaches == {}
    flown.situation.vehicle.height_m = 41.0
    flown.tick(5.0)
    flown.tick(6.0)
    assert flown.record.breaches == {"low": 5.0}


def test_a_mission_can_be_abandoned_between_and_within_steps() -> None:
    flown = Flown("[connect]")
    flown.runner.abandon("interrupted", 1.0)
    assert flown.runner.failure == "interrupted"
    flown = Flown("[connect]")
    flown.tick(0.0)
    flown.runner.abandon("interrupted", 1.0)
    assert flown.runner.failure == "step 1 connect: interrupted"


NEEDED = {"wait_until": "condition: vehicle.is_armed, ", "wait": ""}


@pytest.mark.parametrize("kind", STEP_KINDS)
def test_every_step_that_does_not_come_about_fails_by_its_name(kind: str) -> None:
    keys = "for_s: 1000" if kind == "wait" else f"{NEEDED.get(kind, '')}limit_s: 5"
    flown = Flown(f"[{{{kind}: {{{keys}}}}}, land]", "time_limit_s: 30")
    for tick in range(31):
        flown.tick(float(tick))
    assert flown.runner.is_over
    assert flown.runner.failure.startswith(f"step 1 {kind}: ")
    assert flown.record.steps[-1].ended_s == (30.0 if kind == "wait" else 5.0)
    assert flown.done == []


def test_progress_names_the_step() -> None:
    flown = Flown("[connect, arm]")
    assert flown.runner.progress == (0, 2, "")
    flown.tick(0.0)
    assert flown.runner.progress == (1, 2, "connect")


@pytest.mark.parametrize("step", ["land", "return"])
def test_coming_down_is_asked_for_once_it_is_seen(step: str) -> None:
    flown = Flown(f"[{step}]")
    flown.situation.vehicle.is_armed = True
    flown.tick(0.0)
    flown.situation.vehicle.mode = step
    flown.tick(50.0)
    assert len(flown.crew.asked) == 1
