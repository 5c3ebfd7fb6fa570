"""Modules are loaded before a flight: in flight each would cost the control tick its time."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
FLIGHT = """
import sys
import companion.run  # as the command loads it
from companion.link.endpoint import CompanionEndpoint
from sim_link.autopilot.scenario import AutopilotParams, Scenario
from tools.campaign.flights import monitored_flight
from tests.loop.loop_helpers import AUTO

def watched(name):
    call = getattr(CompanionEndpoint, name)
    def wrapped(self, *arguments):
        before = set(sys.modules)
        result = call(self, *arguments)
        print(*sorted(set(sys.modules) - before), end="")
        return result
    setattr(CompanionEndpoint, name, wrapped)

watched("receive")
watched("handle_timer")
around = monitored_flight(AUTO, Scenario(autopilot=AutopilotParams(flavour=sys.argv[1])), 3)
around.flight.run(60.0)
assert around.notes.results, "nothing was localised"
"""


@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_no_module_is_loaded_in_flight(flavour: str) -> None:
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    command = [sys.executable, "-c", FLIGHT, flavour]
    flown = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert (flown.returncode, flown.stdout) == (0, ""), flown.stderr
