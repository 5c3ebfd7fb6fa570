"""Every rule that binds a companion, tried on ours in memory, shown a PX4 and an ArduPilot."""

from __future__ import annotations

import pytest

from sim_link.lab.conformance.rules import Flavour, Role, Rule, RuleVerdict, try_rule
from tests.protocol.conformance_rigs import (
    case_id,
    cases,
    companion_probe,
    unanswered_companion_probe,
)

NOT_DONE_BY_OURS = {"identity.ping_request_is_answered_rightly": "does not answer PING"}
"""Optional services that our companion does not have, and what the probe must find."""
UNANSWERED = "requests.unanswered_command_is_repeated_a_few_times"
"""Needs a companion that commands by itself."""


@pytest.mark.parametrize(("rule", "flavour"), cases(Role.COMPANION), ids=case_id)
def test_companion_keeps_the_rule(rule: Rule, flavour: Flavour) -> None:
    make_probe = unanswered_companion_probe if rule.rule_id == UNANSWERED else companion_probe
    outcome = try_rule(rule, make_probe(rule.book.prober, flavour))
    if rule.rule_id in NOT_DONE_BY_OURS:
        assert outcome.verdict is RuleVerdict.SKIP
        assert NOT_DONE_BY_OURS[rule.rule_id] in outcome.detail
    else:
        assert outcome.verdict is RuleVerdict.PASS, outcome.detail
