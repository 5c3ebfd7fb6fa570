"""Whole runs on a vehicle that hangs, crashes or never gets ready: reported and restored."""

from __future__ import annotations

import math
import random
import sys

import pytest

from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.incidents import AutopilotStall, Incident, VehicleReboot
from sim_link.autopilot.protocols.addressing import LinkSetup
from sim_link.autopilot.scenario import AutopilotParams, BatteryParams, Scenario
from sim_link.lab.conformance import mavlink_oracle as mav
from sim_link.lab.conformance.cli import all_rules
from sim_link.lab.conformance.protocol_clients import PlanClient, SetpointClient
from sim_link.lab.conformance.rule_run import RuleRun, RunOptions
from sim_link.lab.conformance.rules import (
    CHANGE_FLAG,
    FLIGHT_FLAG,
    HARM_FLAG,
    Effect,
    Flavour,
    Role,
    Rule,
    RuleBook,
    Violation,
    exit_code,
    select,
    summary,
)
from sim_link.lab.conformance.vehicle_rules.parameter_rules import ParameterRules
from tests.protocol.conformance_rigs import BY_ID, SEED
from tests.protocol.memory_link import MemoryHub, MemoryLink

EVERYTHING = frozenset({CHANGE_FLAG, FLIGHT_FLAG, HARM_FLAG})
NEVER_S = 1e9
RULES = select(all_rules(), Role.VEHICLE)
FLAVOURS = pytest.mark.parametrize("flavour", list(Flavour), ids=lambda flavour: flavour.value)


class MemoryRun:
    """A run on a simulated vehicle, and its texts; `stop_s` is the time of Ctrl-C."""

    def __init__(
        self,
        flavour: Flavour,
        *incidents: Incident,
        allowed: frozenset[str] = EVERYTHING,
        ready_after_s: float = 2.0,
        stop_s: float = math.inf,
        has_one_peer: bool = False,
        charge: float = 1.0,
    ) -> None:
        scenario = Scenario(
            autopilot=AutopilotParams(flavour=flavour.value, ready_after_s=ready_after_s),
            battery=BatteryParams(start_share=charge),
            incidents=incidents,
        )
        setup = LinkSetup("station", has_one_peer=has_one_peer)
        self.vehicle = SimEndpoint(scenario, SEED, links=[setup])
        self.stored = self.vehicle.parameters_text
        self.link = MemoryHub(self.vehicle).connect()
        if stop_s < math.inf:
            self.stop_at(stop_s)
        self.texts: list[str] = []
        self.run = RuleRun(
            self.link, RunOptions(allowed=allowed), lambda _: None, self.texts.append
        )

    def stop_at(self, stop_s: float) -> None:
        is_stopped = False

        def poll(until_s: float) -> list[bytes]:
            nonlocal is_stopped
            if self.link.now_s >= stop_s and not is_stopped:
                is_stopped = True
                raise KeyboardInterrupt
            return MemoryLink.poll(self.link, until_s)

        self.link.poll = poll  # type: ignore[method-assign]

    def try_rules(self, *rules: Rule) -> list[str]:
        """The verdicts."""
        self.run.run(rules)
        return [outcome.verdict.value for outcome in self.run.outcomes]

    def require_left_in_order(self) -> None:
        """Assert a disarmed vehicle with its parameters, unless the run reports otherwise."""
        if not self.run.left_behind:
            assert not self.vehicle.vehicle.is_armed
            assert self.vehicle.parameters_text == self.stored


class Mischief(SetpointClient, ParameterRules):
    """Rules that end badly, each with something changed."""

    book = RuleBook("mischief", Effect.FLIES)

    @book.rule("this test")
    def fails_in_flight(self) -> None:
        """It fails while setpoints are streamed and a parameter is changed."""
        self.change(self.float_name, 4.5)
        self.begin_streaming()
        self.set_interval(mav.Attitude, 0.01)
        raise Violation("as it wants")

    @book.rule("this test")
    def breaks_in_flight(self) -> None:
        """The suite itself fails, as by a mistake of ours."""
        self.change(self.integer_name, 1.0)
        self.take_off()
        raise ZeroDivisionError("a mistake")

    @book.rule("this test")
    def flies_far(self) -> None:
        """It flies, which is stopped or fails."""
        self.change(self.integer_name, 1.0)
        self.take_off()
        self.run(20.0)
        self.require_hearing()


FAILS, BREAKS, FLIES_FAR = Mischief.book.rules
HEARTBEAT = BY_ID["heartbeat.once_a_second"]
SENDS_NAN = BY_ID["parameters.nan_is_refused"]


@FLAVOURS
def test_a_vehicle_is_landed_and_restored_after_a_rule_that_fails_or_breaks(
    flavour: Flavour,
) -> None:
    trial = MemoryRun(flavour)
    assert trial.try_rules(FAILS, BREAKS, HEARTBEAT) == ["FAIL", "ERROR", "PASS"]
    assert trial.run.left_behind == []
    trial.require_left_in_order()
    mark = len(trial.texts)
    trial.run.run([BY_ID["streams.stream_can_be_stopped_and_restored"]])
    assert trial.texts[mark:] == []


@FLAVOURS
def test_what_may_do_harm_is_left_out_unless_it_is_allowed(flavour: Flavour) -> None:
    trial = MemoryRun(flavour, allowed=EVERYTHING - {HARM_FLAG})
    assert trial.try_rules(SENDS_NAN, HEARTBEAT) == ["SKIP", "PASS"]
    assert trial.run.outcomes[0].detail == "needs --allow-harm"
    assert exit_code(trial.run.outcomes) == 0


@FLAVOURS
def test_a_vehicle_that_hangs_for_a_while_is_waited_for_and_put_in_order(flavour: Flavour) -> None:
    trial = MemoryRun(flavour, AutopilotStall(start_s=25.0, duration_s=40.0))
    assert trial.try_rules(FLIES_FAR, HEARTBEAT, FAILS) == ["HANG", "PASS", "FAIL"]
    assert "nothing is heard any more" in trial.run.outcomes[0].detail
    assert any("waiting 90 s for it to come back" in text for text in trial.texts)
    assert trial.run.left_behind == []
    trial.require_left_in_order()
    assert exit_code(trial.run.outcomes) == 1


@FLAVOURS
def test_a_vehicle_that_crashes_and_boots_again_gets_its_parameters_back(flavour: Flavour) -> None:
    trial = MemoryRun(flavour, VehicleReboot(start_s=25.0, down_s=30.0))
    assert trial.try_rules(FLIES_FAR, HEARTBEAT) == ["HANG", "PASS"]
    assert trial.run.left_behind == []
    trial.require_left_in_order()


@FLAVOURS
def test_the_rest_is_not_run_on_a_vehicle_that_stays_silent(flavour: Flavour) -> None:
    trial = MemoryRun(flavour, VehicleReboot(start_s=25.0, down_s=NEVER_S))
    assert trial.try_rules(FLIES_FAR, HEARTBEAT, FAILS) == ["HANG", "NOT RUN", "NOT RUN"]
    assert trial.run.outcomes[2].detail == "the vehicle is silent"
    name = "COM_OBL_RC_ACT" if flavour is Flavour.PX4 else "FS_GCS_ENABLE"
    assert trial.run.left_behind[0].startswith(f"{name} is not restored: set it to ")
    assert trial.link.now_s < 25.0 + 150.0


@FLAVOURS
def test_a_vehicle_that_never_gets_ready_is_waited_for_once(flavour: Flavour) -> None:
    trial = MemoryRun(flavour, ready_after_s=NEVER_S)
    assert trial.try_rules(FAILS, BREAKS, HEARTBEAT) == ["NOT RUN", "NOT RUN", "PASS"]
    is_px4 = flavour is Flavour.PX4
    missing = "not ready to arm" if is_px4 else "no LOCAL_POSITION_NED"
    assert f"{missing} within 90 s" in trial.run.outcomes[1].detail
    what = "ready to arm within 90 s (SYS_STATUS, PREARM_CHECK)"
    waited_for = what if is_px4 else "LOCAL_POSITION_NED within 90 s"
    assert trial.texts == [f"waiting for the vehicle: {waited_for}"]
    assert trial.link.now_s < 120.0
    trial.require_left_in_order()
    assert exit_code(trial.run.outcomes) == 1


@FLAVOURS
def test_ctrl_c_in_flight_lands_restores_and_tells(flavour: Flavour) -> None:
    trial = MemoryRun(flavour, stop_s=20.0)
    assert trial.try_rules(FLIES_FAR, FAILS) == ["NOT RUN", "NOT RUN"]
    assert trial.run.outcomes[0].detail == "stopped"
    assert trial.run.left_behind == []
    trial.require_left_in_order()


def test_ctrl_c_before_anything_is_heard_is_reported_too() -> None:
    trial = MemoryRun(Flavour.PX4, VehicleReboot(start_s=0.0, down_s=NEVER_S), stop_s=3.0)
    assert trial.try_rules(HEARTBEAT, FLIES_FAR) == ["NOT RUN", "NOT RUN"]
    assert exit_code(trial.run.outcomes) == 1
    assert trial.run.left_behind == []


@FLAVOURS
def test_plans_and_the_mode_are_as_they_were(flavour: Flavour) -> None:
    trial = MemoryRun(flavour)
    pilot = PlanClient(trial.link)
    pilot.attach()
    pilot.get_ready()
    wanted = pilot.prepare(2)
    pilot.set_mode("hold" if flavour is Flavour.PX4 else "loiter")
    before = pilot.heartbeat().custom_mode
    assert trial.try_rules(*select(RULES, Role.VEHICLE, "missions.*"))
    assert trial.run.left_behind == []
    after = PlanClient(trial.link)
    after.attach()
    after.require_stored(wanted)
    assert after.heartbeat().custom_mode == before


@FLAVOURS
def test_rules_with_two_clients_are_left_out_where_one_is_served(flavour: Flavour) -> None:
    trial = MemoryRun(flavour, has_one_peer=True)
    verdicts = trial.try_rules(*select(RULES, Role.VEHICLE, "routing.*"))
    assert verdicts.count("SKIP") >= 8
    assert "FAIL" not in verdicts
    reasons = {each.detail for each in trial.run.outcomes if each.verdict.value == "SKIP"}
    assert reasons == {"this link serves one client only"}


@FLAVOURS
def test_nothing_flies_on_an_empty_battery_unless_a_simulator_may_restart(flavour: Flavour) -> None:
    careful = MemoryRun(flavour, charge=0.2, allowed=EVERYTHING - {HARM_FLAG})
    assert careful.try_rules(FAILS, HEARTBEAT) == ["NOT RUN", "PASS"]
    assert "battery at 20 %: charge it" in careful.run.outcomes[0].detail
    careful.require_left_in_order()
    assert MemoryRun(flavour, charge=0.2).try_rules(FAILS) == ["FAIL"]


SLOW, CAMPAIGN = pytest.mark.slow, pytest.mark.campaign


def incidents_of(number: int) -> tuple[list[Incident], float, float]:
    """Return the incidents of a run, the time it is ready, and that of Ctrl-C."""
    start_s = random.Random(number).uniform(20.0, 900.0)
    stall = AutopilotStall(start_s=start_s, duration_s=30.0)
    runs: list[tuple[list[Incident], float, float]] = [
        ([stall], 2.0, math.inf),
        ([VehicleReboot(start_s=start_s, down_s=20.0)], 2.0, math.inf),
        ([], NEVER_S, math.inf),
        ([VehicleReboot(start_s=start_s, down_s=NEVER_S)], 2.0, math.inf),
        ([stall], 2.0, start_s + 40.0),
    ]
    return runs[number % len(runs)]


@pytest.mark.parametrize(
    "number", [pytest.param(n, marks=SLOW if n in (1, 2, 4) else CAMPAIGN) for n in range(10)]
)
@FLAVOURS
def test_twenty_runs_end_with_a_summary_and_the_vehicle_as_it_was(
    flavour: Flavour, number: int
) -> None:
    incidents, ready_after_s, stop_s = incidents_of(number)
    trial = MemoryRun(flavour, *incidents, ready_after_s=ready_after_s, stop_s=stop_s)
    verdicts = trial.try_rules(*RULES)
    assert len(verdicts) == sum(flavour in rule.flavours for rule in RULES)
    assert "ERROR" not in verdicts
    is_gone, may_pass_unseen = number % 5 == 3, number % 5 < 2
    code = exit_code(trial.run.outcomes, trial.run.problems)
    assert code == 1 or (may_pass_unseen and code == 3)
    assert is_gone or trial.run.left_behind == []
    trial.require_left_in_order()
    texts = [flavour.value, str(number), summary(trial.run.outcomes), *trial.run.problems]
    sys.stdout.write("; ".join(texts) + "\n")  # pytest -s shows it
