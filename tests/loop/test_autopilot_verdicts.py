"""The companion judges as the autopilot judges: estimator votes, receivers, RC input, landing."""

from __future__ import annotations

import pytest

from companion.guidance.phases import IN_CONTROL, Phase
from sim_link.autopilot.estimator import GpsParams
from sim_link.autopilot.incidents import (
    EkfPoor,
    EstimatorVote,
    FalseLanding,
    GpsLoss,
    PilotSticks,
    RcLoss,
)
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, RcParams, Scenario
from tests.loop.loop_helpers import AUTO, SELDOM, Loop, flown_once

FLAVOURS: tuple[FlavourName, ...] = ("px4", "ardupilot")
GOES_ON_WITHOUT_RC = {"px4": {"COM_RCL_EXCEPT": 4.0}, "ardupilot": {"FS_OPTIONS": 4.0}}
THROTTLE_LOW, STICKS_ASIDE = (0.0, 0.0, -1.0, 0.0), (0.6, -0.6, -1.0, 0.0)
pytestmark = pytest.mark.parametrize("flavour", FLAVOURS)


@flown_once
def flying(flavour: FlavourName, receivers: int = 1, *, has_rc: bool = False) -> Loop:
    """A flight in mid-search."""
    parameters = GOES_ON_WITHOUT_RC[flavour] if has_rc else {}
    scenario = Scenario(
        autopilot=AutopilotParams(flavour=flavour, parameters=parameters),
        gps=GpsParams(receivers=2 if receivers == 2 else 1),
        rc=RcParams(is_present=has_rc),
        payload=SELDOM,
    )
    loop = Loop(AUTO, scenario, 2)
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 40.0)
    loop.run(2.0)
    return loop


@pytest.mark.parametrize("receiver", ["first", "second"])
def test_one_receiver_of_two_may_lose_its_fix(flavour: FlavourName, receiver: str) -> None:
    loop = flying(flavour, receivers=2)
    loop.flight.apply_incident(GpsLoss(receiver="first" if receiver == "first" else "second"))
    loop.run(8.0)
    assert loop.phase in (Phase.NORMAL, Phase.FINISHED)
    assert not loop.said("GNSS fix")


@pytest.mark.parametrize("receivers", [1, 2])
def test_all_receivers_without_a_fix_end_control(flavour: FlavourName, receivers: int) -> None:
    loop = flying(flavour, receivers)
    loop.flight.apply_incident(GpsLoss())
    loop.run(1.5)
    assert loop.phase in (Phase.HOLD, Phase.YIELD)
    assert loop.said("hold: autopilot lost GNSS fix")
    loop.run(15.0)
    assert loop.phase not in IN_CONTROL


@pytest.mark.parametrize("of", ["compass", "height"])
def test_one_vote_alone_changes_nothing(flavour: FlavourName, of: EstimatorVote) -> None:
    loop = flying(flavour)
    loop.flight.apply_incident(EkfPoor(ratio=1.5, of=of))
    loop.run(8.0)
    assert loop.phase in (Phase.NORMAL, Phase.FINISHED)
    assert not loop.said("position estimate is poor")


@pytest.mark.parametrize("of", ["velocity", "all"])
def test_what_the_autopilot_calls_poor_is_held_on(flavour: FlavourName, of: EstimatorVote) -> None:
    loop = flying(flavour)
    loop.flight.apply_incident(EkfPoor(ratio=2.5, of=of))
    loop.run(8.0)
    assert loop.phase not in (Phase.NORMAL, Phase.FINISHED)


def test_the_position_alone_is_a_verdict_on_px4_only(flavour: FlavourName) -> None:
    loop = flying(flavour)
    loop.flight.apply_incident(EkfPoor(ratio=1.5, of="position", duration_s=4.0))
    loop.run(3.0)
    assert loop.said("position estimate is poor") is (flavour == "px4")


@pytest.mark.parametrize("pulses", [THROTTLE_LOW, STICKS_ASIDE, None])
def test_a_failsafe_position_of_the_receiver_is_no_pilot(
    flavour: FlavourName, pulses: tuple[float, float, float, float] | None
) -> None:
    loop = flying(flavour, has_rc=True)
    loop.flight.apply_incident(RcLoss(pulses=pulses, duration_s=6.0))
    loop.run(10.0)
    assert not loop.said("control yielded")
    assert loop.phase in (Phase.NORMAL, Phase.FINISHED)


def test_a_pilot_who_moves_the_sticks_still_gets_the_vehicle(flavour: FlavourName) -> None:
    loop = flying(flavour, has_rc=True)
    loop.flight.apply_incident(PilotSticks(forward=0.8, duration_s=10.0))
    loop.run(3.0)
    assert loop.phase is Phase.YIELD


@pytest.mark.parametrize("lasts_s", [0.6, 3.0, 8.0])
def test_a_landing_that_is_reported_in_flight_is_doubted(
    flavour: FlavourName, lasts_s: float
) -> None:
    loop = flying(flavour)
    loop.flight.apply_incident(FalseLanding(duration_s=lasts_s))
    loop.run(lasts_s)
    assert loop.phase in IN_CONTROL
    loop.run_until(lambda: loop.phase in (Phase.NORMAL, Phase.FINISHED), 3.0)
    assert not loop.said("control lost")
