"""Every rule that binds a vehicle, tried on the simulator in memory, as PX4 and as ArduPilot."""

from __future__ import annotations

import pytest

from sim_link.lab.conformance.rules import Flavour, Role, Rule, RuleVerdict, try_rule
from tests.protocol.conformance_rigs import (
    KEY,
    case_id,
    cases,
    probe_of,
    signing_simulator,
    simulator,
    try_on_vehicle,
)

GOOD = (RuleVerdict.PASS, RuleVerdict.NOTED)
"""Rules in which the simulator may be as lax as the real autopilot of a note."""
NO_OCCASION = {
    ("commands.long_running_command_reports_and_can_be_cancelled", Flavour.ARDUPILOT): (
        "calibration is answered by 0 at once"
    )
}


@pytest.mark.parametrize(("rule", "flavour"), cases(Role.VEHICLE), ids=case_id)
def test_simulator_keeps_the_rule(rule: Rule, flavour: Flavour) -> None:
    if rule.rule_id.startswith("signing."):
        outcome = try_rule(rule, probe_of(signing_simulator(flavour), rule.book.prober, KEY))
    else:
        outcome = try_on_vehicle(rule, simulator(flavour))
    reason = NO_OCCASION.get((rule.rule_id, flavour))
    if reason is not None:
        assert (outcome.verdict, outcome.detail) == (RuleVerdict.SKIP, reason)
        return
    assert outcome.verdict in GOOD, outcome.detail


@pytest.mark.parametrize(
    ("rule", "flavour"),
    [case for case in cases(Role.VEHICLE) if case[0].rule_id.startswith("frames.")],
    ids=case_id,
)
def test_simulator_keeps_the_rule_on_a_byte_stream(rule: Rule, flavour: Flavour) -> None:
    outcome = try_rule(rule, probe_of(simulator(flavour), rule.book.prober, is_datagram=False))
    assert outcome.verdict in GOOD, outcome.detail
