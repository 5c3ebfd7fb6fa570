"""Every rule that binds a vehicle, tried on the simulator in memory, as PX4 and as ArduPilot."""

from __future__ import annotations

import pytest

from sim_link.conformance.rules import Flavour, Role, Rule
from sim_link.conformance.runner import Verdict
from tests.protocol.conformance_rigs import case_id, cases, simulator, try_on_vehicle

CASES = [
    (rule, flavour)
    for rule, flavour in cases(Role.VEHICLE)
    if not rule.rule_id.startswith("signing.")
]


@pytest.mark.parametrize(("rule", "flavour"), CASES, ids=case_id)
def test_simulator_keeps_the_rule(rule: Rule, flavour: Flavour) -> None:
    outcome = try_on_vehicle(rule, simulator(flavour))
    assert outcome.verdict is Verdict.PASS, outcome.detail
