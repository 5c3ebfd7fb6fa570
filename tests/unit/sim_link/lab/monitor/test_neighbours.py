"""Other vehicles with the ids of ours: what they may change, and setpoints that reach them."""

from __future__ import annotations

import pytest

from companion.config.schema import CompanionConfig
from companion.guidance.commands import SessionParams
from companion.guidance.phases import IN_CONTROL, Phase
from sim_link.autopilot.incidents import OtherVehicle, VehicleTypeName
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from sim_link.lab.faults.fault_models import ForgedFrames, Schedule
from tests.loop.loop_helpers import said
from tests.planted_companions import Planted, SendsToEverybody, maker
from tools.campaign.flights import Monitored, monitored_flight

AUTO = CompanionConfig(mission=SessionParams(engage="auto", stop_confirm_s=1e6))
OPERATED = CompanionConfig()
FLAVOURS: tuple[FlavourName, ...] = ("px4", "ardupilot")


def flown(
    flavour: FlavourName,
    fault: OtherVehicle | ForgedFrames,
    config: CompanionConfig = AUTO,
    *,
    is_signed: bool = False,
    defect: type[Planted] | None = None,
    seed: int = 3,
) -> Monitored:
    """A flight in which something else sends under the ids of our vehicle for a few seconds."""
    scenario = Scenario(autopilot=AutopilotParams(flavour=flavour))
    make = None if defect is None else maker(defect)
    around = monitored_flight(config, scenario, seed, is_signed=is_signed, make_companion=make)
    around.flight.run(18.0)
    around.injector.inject(Schedule(faults=(fault,)))
    around.flight.run(10.0)
    return around


@pytest.mark.slow
@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("is_offboard", [True, False])
def test_a_signed_link_flies_on_beside_an_unsigned_vehicle_with_our_ids(
    flavour: FlavourName, *, is_offboard: bool
) -> None:
    """All that it sends is refused; else any forged frame could end control."""
    alike = OtherVehicle(
        system_id=1, duration_s=8.0, has_own_address=False, is_offboard=is_offboard
    )
    around = flown(flavour, alike, is_signed=True)
    assert around.flight.companion.session.phase in IN_CONTROL
    assert said(around.notes, "x unsigned")
    assert around.monitor.violations == []


@pytest.mark.slow
@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("vehicle_type", ["quadrotor", "hexarotor", "rover"])
def test_without_a_key_one_behind_our_address_ends_control(
    flavour: FlavourName, vehicle_type: VehicleTypeName
) -> None:
    alike = OtherVehicle(
        system_id=1, duration_s=8.0, has_own_address=False, vehicle_type=vehicle_type
    )
    around = flown(flavour, alike)
    assert around.flight.companion.session.phase is Phase.YIELD
    assert around.monitor.violations == []


@pytest.mark.slow
@pytest.mark.parametrize("flavour", FLAVOURS)
def test_one_at_another_address_bars_control_before_it_was_given_and_changes_nothing_else(
    flavour: FlavourName,
) -> None:
    around = flown(flavour, OtherVehicle(system_id=1, duration_s=8.0), OPERATED)
    assert said(around.notes, "two vehicles send as 1/1")
    assert around.flight.companion.session.phase is Phase.WAITING
    assert around.monitor.violations == []


@pytest.mark.slow
@pytest.mark.parametrize("flavour", FLAVOURS)
def test_forged_frames_bar_control_where_their_clock_runs_and_change_nothing_else(
    flavour: FlavourName,
) -> None:
    """Random frames of the past have a clock that runs by chance, in most flights."""
    forged, barred = ForgedFrames(duration_s=8.0, rate_hz=12.0), 0
    for seed in range(3, 9):
        around = flown(flavour, forged, OPERATED, seed=seed)
        is_barred = said(around.notes, "two vehicles send as 1/1")
        phase = Phase.WAITING if is_barred else Phase.STANDBY
        assert around.flight.companion.session.phase is phase
        assert around.monitor.violations == []
        barred += is_barred
    assert barred >= 2


@pytest.mark.slow
@pytest.mark.parametrize("flavour", FLAVOURS)
def test_one_at_another_address_ends_no_control(flavour: FlavourName) -> None:
    around = flown(flavour, OtherVehicle(system_id=1, duration_s=8.0))
    assert around.flight.companion.session.phase in IN_CONTROL
    assert around.monitor.violations == []


@pytest.mark.slow
@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("system_id", [1, 2])
def test_a_setpoint_to_another_vehicle_is_found(flavour: FlavourName, system_id: int) -> None:
    other = OtherVehicle(system_id=system_id, duration_s=8.0)
    around = flown(flavour, other, defect=SendsToEverybody)
    found = [violation.what for violation in around.monitor.violations]
    assert ("a setpoint or a request to another vehicle" in found) is (system_id == 1)
