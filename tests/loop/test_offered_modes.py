"""ArduPilot's mode 30, OFFBOARD: flown where a vehicle offers it, and unknown anywhere else."""

from __future__ import annotations

import pytest

from companion.config.schema import CompanionConfig
from companion.domain import FlightMode
from companion.guidance.phases import IN_CONTROL
from companion.mav.dialect import mavlink
from sim_link.autopilot.incidents import VehicleReboot
from sim_link.autopilot.scenario import AutopilotParams, Scenario
from sim_link.lab.faults.fault_models import LinkLoss, Schedule
from tests.loop.loop_helpers import Loop

OFFBOARD, GUIDED, LOITER = 30, 4, 5


class Copter(Loop):
    """An ArduCopter in the air, in LOITER; its modes are chosen by number."""

    def __init__(self, *, offers_offboard: bool, loss: float = 0.0) -> None:
        autopilot = AutopilotParams(flavour="ardupilot", offers_offboard=offers_offboard)
        faults = Schedule(faults=(LinkLoss(share=loss),) if loss else ())
        super().__init__(CompanionConfig(), Scenario(autopilot=autopilot), faults=faults)

    def rise(self) -> Copter:
        self.run(4.0)
        self.choose_number(GUIDED)
        self.operator.arm()
        self.command(mavlink.MAV_CMD_NAV_TAKEOFF, *[0.0] * 6, 12.0)
        self.run(10.0)
        self.flight.sim.vehicle.flavour.pilot_chooses(FlightMode.POSITION, self.now_s)
        self.run(3.0)
        return self

    def choose_number(self, number: int) -> None:
        flag = float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED)
        self.command(mavlink.MAV_CMD_DO_SET_MODE, flag, float(number), *[0.0] * 5)
        self.run(0.1)

    @property
    def is_in_control(self) -> bool:
        return self.phase in IN_CONTROL


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_mode_30_gives_control_where_it_is_offered(loss: float) -> None:
    copter = Copter(offers_offboard=True, loss=loss).rise()
    copter.run(5.0)  # the list is whole, also where frames were lost
    copter.choose_number(OFFBOARD)
    copter.run(3.0)
    assert copter.is_in_control, copter.notes.texts
    assert copter.said("in control: autopilot is in OFFBOARD")
    copter.choose_number(GUIDED)
    copter.run(2.0)
    assert copter.is_in_control
    copter.choose_number(LOITER)
    copter.run(2.0)
    assert not copter.is_in_control
    heard_s = max(at_s for at_s, text in copter.notes.texts if text.startswith("control lost"))
    assert copter.setpoints_since(heard_s) == []


def test_mode_30_never_gives_control_where_it_is_not_offered() -> None:
    copter = Copter(offers_offboard=False).rise()
    began_s = copter.now_s
    copter.choose_number(OFFBOARD)
    assert copter.sim.vehicle.flavour.heartbeat_state(copter.now_s).custom_mode == LOITER
    copter.sim.vehicle.flavour.chosen_number = OFFBOARD  # type: ignore[attr-defined]
    copter.run(5.0)
    assert not copter.is_in_control
    assert copter.setpoints_since(began_s) == []


def test_a_vehicle_that_is_found_in_mode_30_is_flown_only_after_it_left_it() -> None:
    copter = Copter(offers_offboard=True)
    copter.is_link_up = False
    copter.rise().choose_number(OFFBOARD)
    copter.is_link_up = True
    copter.run(10.0)
    assert not copter.is_in_control
    assert copter.setpoints == []
    copter.choose_number(LOITER)
    copter.run(3.0)
    copter.choose_number(OFFBOARD)
    copter.run(3.0)
    assert copter.is_in_control, copter.notes.texts


def test_mode_30_is_asked_for_again_after_a_restart_of_the_autopilot() -> None:
    copter = Copter(offers_offboard=True)
    copter.run(6.0)
    modes = copter.companion.executor.inbound._modes
    assert modes.understands_offboard
    copter.flight.apply_incident(VehicleReboot())
    copter.run_until(lambda: not modes.understands_offboard, 10.0)
    copter.run_until(lambda: modes.understands_offboard, 10.0)
