"""Other vehicles on the link, by address, by id and by class: none of them is ever flown."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial

import msgspec
import pytest

from companion.config.schema import CompanionConfig
from companion.domain import FlightMode, PositionEnu
from companion.guidance.phases import IN_CONTROL, Phase
from companion.link.identity import DOUBT_S
from companion.mav.dialect import mavlink
from sim_link.autopilot.incidents import (
    ComponentName,
    OtherComponent,
    OtherVehicle,
    PilotMode,
    VehicleTypeName,
)
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from sim_link.lab.faults.fault_models import LinkBlackout
from sim_link.lab.faults.faulty_link import Injector
from sim_link.lab.observer import Frame, Observer
from sim_link.neighbours import Neighbour
from tests.loop.loop_helpers import SELDOM, Loop, flown_once

SLOW = partial(pytest.param, marks=pytest.mark.slow)
FLAVOURS: tuple[FlavourName, ...] = ("px4", "ardupilot")
SETPOINTS = (
    mavlink.MAVLink_set_position_target_local_ned_message,
    mavlink.MAVLink_set_position_target_global_int_message,
)
ASKING = (
    mavlink.MAV_CMD_DO_SET_MODE,
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM,
    mavlink.MAV_CMD_NAV_TAKEOFF,
)


@dataclass
class Reached(Observer):
    """Setpoints and requests that reached another vehicle with its ids, and when."""

    setpoints: list[float] = field(default_factory=list)
    requests: list[float] = field(default_factory=list)

    def neighbour_heard(self, frame: Frame, neighbour: Neighbour) -> None:
        message = frame.message
        target = getattr(message, "target_system", None)
        if target not in (0, neighbour.setup.system_id):
            return
        if isinstance(message, SETPOINTS):
            self.setpoints.append(frame.time_s)
        if isinstance(message, mavlink.MAVLink_command_long_message) and message.command in ASKING:
            self.requests.append(frame.time_s)


class Sky(Loop):
    """A flight with other vehicles in the air."""

    def __init__(
        self,
        flavour: FlavourName,
        *,
        listens: bool = False,
        vehicle_type: VehicleTypeName = "quadrotor",
        uid: int | None = None,
    ) -> None:
        autopilot = AutopilotParams(flavour=flavour, vehicle_type=vehicle_type, uid=uid)
        scenario = Scenario(autopilot=autopilot, payload=SELDOM)
        super().__init__(CompanionConfig(), scenario, listens=listens)
        self.injector = Injector(self.flight, self.wire, self.operator)
        self.reached = Reached()
        self.flight.observers.append(self.reached)

    def rise(self) -> Sky:
        """Take off, the operator's way."""
        self.run(4.0)
        is_px4 = self.flight.scenario.autopilot.flavour == "px4"
        if not is_px4:
            self.choose(FlightMode.OFFBOARD)
        self.operator.arm()
        up_m = 12.0 + (self.flight.scenario.origin.altitude_m if is_px4 else 0.0)
        self.command(mavlink.MAV_CMD_NAV_TAKEOFF, *[math.nan if is_px4 else 0.0] * 6, up_m)
        self.run(10.0)
        return self

    def in_control(self) -> Sky:
        self.rise().give()
        assert self.phase in IN_CONTROL, self.notes.texts
        return self

    def give(self) -> None:
        """Leave the mode for long enough, and give it again."""
        if self.phase is Phase.YIELD:
            self.choose(FlightMode.LAND)
            self.run(0.5)
            self.grant()
            self.run(2.0)
        self.choose(FlightMode.OFFBOARD)
        self.run(2.0)

    @property
    def is_copter(self) -> bool:
        return self.flight.scenario.autopilot.flavour == "ardupilot"

    def add(self, *faults: OtherVehicle | LinkBlackout) -> None:
        for fault in faults:
            self.injector.add(fault)

    @property
    def said_of_identity(self) -> list[str]:
        parts = ("control ended", "no control", "another vehicle")
        return [text for _, text in self.notes.texts if any(part in text for part in parts)]

    @property
    def other_moved_m(self) -> float:
        (other,) = self.flight.neighbours
        return math.dist(other.position_enu_m, other.setup.position_enu_m)


OURS_1_1 = OtherVehicle(system_id=1)


@flown_once
def in_control(flavour: FlavourName, uid: int | None = None) -> Sky:
    return Sky(flavour, uid=uid).in_control()


@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("silent_s", [4.0, SLOW(7.0), 20.0])
def test_a_neighbour_with_our_ids_at_another_address_is_not_flown_while_ours_is_silent(
    flavour: FlavourName, silent_s: float
) -> None:
    """qgroundcontrol#14812: 542 setpoints went to the neighbour."""
    sky = in_control(flavour)
    sky.add(OURS_1_1)
    sky.run(2.0)
    assert sky.phase in IN_CONTROL  # ours is heard: other senders are ignored
    sky.add(LinkBlackout(duration_s=silent_s))
    sky.run(silent_s)
    assert sky.phase is Phase.YIELD
    assert sky.reached.setpoints == sky.reached.requests == []
    assert sky.other_moved_m < 1.0
    (text,) = [text for text in sky.said_of_identity if "control ended" in text]
    assert "1/1 at 127.0.0.1:18000 is another vehicle: boot clocks" in text
    sky.run(6.0)
    assert sky.companion.binding.peer != ("127.0.0.1", 18000)  # ours came back, and is heard
    assert sky.reached.setpoints == []
    sky.give()
    assert sky.phase not in IN_CONTROL  # two send as 1/1: never
    assert sky.companion.binding.problem is not None


@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("uptime_s", [0.5, SLOW(30.0), 500.0, SLOW(90_000.0)])
def test_two_vehicles_with_our_ids_by_one_address_are_never_flown(
    flavour: FlavourName, uptime_s: float
) -> None:
    sky = Sky(flavour)
    sky.add(msgspec.structs.replace(OURS_1_1, has_own_address=False, uptime_s=uptime_s))
    sky.rise().give()
    sky.run(2.0)
    assert sky.phase not in IN_CONTROL
    assert [text for _, text in sky.notes.texts if "in control" in text] == []
    twos = [text for text in sky.said_of_identity if "two vehicles send as 1/1" in text]
    assert len(twos) == 1, sky.notes.texts


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_control_ends_within_a_moment_when_a_second_vehicle_appears_by_our_address(
    flavour: FlavourName,
) -> None:
    sky = in_control(flavour)
    sky.add(msgspec.structs.replace(OURS_1_1, has_own_address=False))
    began_s = sky.now_s
    sky.run(4.0)
    assert sky.phase not in IN_CONTROL
    assert max(sky.reached.setpoints, default=began_s) < began_s + 2.0
    sky.give()
    assert sky.phase not in IN_CONTROL


@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("uptime_s", [100.0, 500.0])
def test_a_neighbour_in_place_of_ours_behind_one_address_is_not_flown(
    flavour: FlavourName, uptime_s: float
) -> None:
    sky = in_control(flavour)
    sky.add(LinkBlackout(direction="to_companion"))
    sky.run(2.0)
    sky.add(msgspec.structs.replace(OURS_1_1, has_own_address=False, uptime_s=sky.now_s + uptime_s))
    began_s = sky.now_s
    sky.run(10.0)
    assert sky.phase not in IN_CONTROL
    assert max(sky.reached.setpoints, default=began_s) < began_s + 1.0
    (text,) = [text for text in sky.said_of_identity if "control ended" in text]
    assert "1/1 is another vehicle now: " in text  # its hardware id, or its clock


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_ours_is_flown_again_when_the_other_has_gone_and_the_mode_is_given(
    flavour: FlavourName,
) -> None:
    sky = in_control(flavour)
    other = msgspec.structs.replace(OURS_1_1, has_own_address=False, duration_s=5.0)
    sky.add(other)
    sky.run(5.0)
    assert sky.phase not in IN_CONTROL
    sky.run(DOUBT_S + 2.0)
    assert sky.phase not in IN_CONTROL  # not by itself
    sky.give()
    assert sky.phase in IN_CONTROL, sky.notes.texts


@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("is_first", [True, False])
def test_two_systems_and_no_configured_id_wait_and_are_named(
    flavour: FlavourName, is_first: bool
) -> None:
    """dronekit#1158: 106 setpoints went to the neighbour that was heard first."""
    sky = Sky(flavour, listens=True)
    sky.add(OtherVehicle(start_s=0.0 if is_first else 6.0))
    sky.rise().give()
    assert sky.phase is Phase.WAITING
    assert sky.reached.setpoints == sky.reached.requests == []
    text = "no control: systems 1 and 2 are autopilots on this link: set vehicle.system_id"
    assert sky.said_of_identity == [text]


@pytest.mark.parametrize(
    ("flavour", "has_own_address", "other"),
    [
        ("px4", True, "ardupilot"),
        ("ardupilot", True, "px4"),
        ("px4", False, "px4"),
        ("ardupilot", False, "ardupilot"),
        SLOW("px4", True, "px4"),
        SLOW("ardupilot", True, "ardupilot"),
        SLOW("px4", False, "ardupilot"),
        SLOW("ardupilot", False, "px4"),
    ],
)
def test_a_configured_id_is_flown_beside_others(
    flavour: FlavourName, has_own_address: bool, other: FlavourName
) -> None:
    sky = Sky(flavour)
    sky.add(OtherVehicle(has_own_address=has_own_address, flavour=other))
    sky.in_control()
    sky.run(5.0)
    assert sky.phase in IN_CONTROL
    assert sky.reached.setpoints == sky.reached.requests == []
    assert sky.said_of_identity == []


REFUSED: dict[VehicleTypeName, str] = {
    "plane": "fixed wing",
    "quadplane": "VTOL",
    "tiltrotor": "VTOL",
    "tailsitter": "VTOL",
    "rover": "rover",
    "boat": "boat",
    "sub": "submarine",
    "generic": "vehicle without a frame class",
}
MORE_ROTORS = ("octorotor", "tricopter", "dodecarotor", "decarotor")


def position(sky: Sky) -> PositionEnu:
    return sky.sim.vehicle.body.position_enu_m


@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("vehicle_type", REFUSED)
def test_a_class_that_is_not_flown_is_named_and_neither_flown_nor_asked(
    flavour: FlavourName, vehicle_type: VehicleTypeName
) -> None:
    """ArduPilot/mavlink#61: a plane in ACRO (4) was "in GUIDED", and was asked for QSTABILIZE."""
    sky = Sky(flavour, vehicle_type=vehicle_type)
    sky.run(4.0)
    for mode in (FlightMode.ACRO, FlightMode.OFFBOARD, FlightMode.HOLD, FlightMode.OFFBOARD):
        sky.flight.apply_incident(PilotMode(mode=mode))
        sky.run(2.0)
    assert sky.setpoints == []
    assert not [number for _, number in sky.commands if number in ASKING]
    text = f"no control: only multicopters are supported: this is a {REFUSED[vehicle_type]}"
    assert [said for said in sky.said_of_identity] == [text]


@pytest.mark.parametrize(
    ("flavour", "vehicle_type"),
    [
        ("px4", "hexarotor"),
        ("ardupilot", "hexarotor"),
        ("px4", "coaxial"),
        ("ardupilot", "helicopter"),
        SLOW("ardupilot", "coaxial"),
        SLOW("px4", "helicopter"),
        *(SLOW(flavour, name) for flavour in FLAVOURS for name in MORE_ROTORS),
    ],
)
def test_a_class_that_hovers_is_flown(flavour: FlavourName, vehicle_type: VehicleTypeName) -> None:
    sky = Sky(flavour, vehicle_type=vehicle_type).in_control()
    assert sky.said_of_identity == []


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_a_class_that_changes_in_flight_ends_control(flavour: FlavourName) -> None:
    sky = in_control(flavour)
    scenario = sky.sim.vehicle.scenario
    autopilot = msgspec.structs.replace(scenario.autopilot, vehicle_type="plane")
    sky.sim.vehicle.scenario = msgspec.structs.replace(scenario, autopilot=autopilot)
    began_s = sky.now_s
    sky.run(3.0)
    assert sky.phase not in IN_CONTROL
    assert not [sent for sent in sky.setpoints if sent.time_s > began_s + 1.1]
    assert len([text for text in sky.said_of_identity if "control ended" in text]) == 1


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_beside_mavros_the_companion_takes_another_id_and_flies(flavour: FlavourName) -> None:
    sky = Sky(flavour)
    sky.flight.apply_incident(OtherComponent(component="mavros"))
    sky.in_control()
    assert sky.companion.outlet.own_ids == (1, 192)
    said = [text for _, text in sky.notes.texts if "sending as 192" in text]
    assert len(said) == 1


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_in_control_the_id_stays_beside_mavros(flavour: FlavourName) -> None:
    sky = in_control(flavour)
    sky.flight.apply_incident(OtherComponent(component="mavros"))
    sky.run(6.0)
    assert sky.companion.outlet.own_ids == (1, 191)
    assert sky.phase in IN_CONTROL


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_beside_a_second_companion_there_is_no_control(flavour: FlavourName) -> None:
    sky = Sky(flavour)
    sky.flight.apply_incident(OtherComponent(component="companion"))
    sky.rise().give()
    assert sky.phase not in IN_CONTROL
    assert sky.companion.outlet.own_ids == (1, 191)


@pytest.mark.parametrize(
    ("flavour", "component"),
    [
        ("px4", "gimbal"),
        ("ardupilot", "camera"),
        ("px4", "adsb"),
        ("ardupilot", "router"),
        ("px4", "station"),
        SLOW("ardupilot", "gimbal"),
        SLOW("px4", "camera"),
        SLOW("ardupilot", "adsb"),
        SLOW("px4", "router"),
        SLOW("ardupilot", "station"),
    ],
)
def test_what_is_no_autopilot_is_never_bound(
    flavour: FlavourName, component: ComponentName
) -> None:
    sky = Sky(flavour, listens=True)
    sky.flight.apply_incident(OtherComponent(component=component))
    sky.in_control()
    assert sky.companion.binding.system_id == 1
    assert sky.companion.binding.component_id == 1


def twin_at_another_address(sky: Sky) -> OtherVehicle:
    """Return a vehicle with our ids, boot clock and position: only the hardware id differs."""
    east_m, north_m, up_m = sky.true_positions[-1]
    return OtherVehicle(
        system_id=1, uptime_s=sky.now_s, east_m=east_m + 2.0, north_m=north_m, up_m=up_m
    )


@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("silent_s", [5.0, 9.0])
def test_a_twin_with_our_clock_and_place_is_refused_by_its_hardware_id(
    flavour: FlavourName, silent_s: float
) -> None:
    sky = in_control(flavour)
    sky.add(twin_at_another_address(sky))
    sky.add(LinkBlackout(duration_s=silent_s))
    sky.run(silent_s)
    assert sky.phase not in IN_CONTROL
    assert len(sky.reached.setpoints) * 0.05 <= 1.5  # until the question was answered
    assert any("hardware" in text for text in sky.said_of_identity)


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_the_hardware_id_of_ours_is_asked_for_and_known(flavour: FlavourName) -> None:
    sky = in_control(flavour)
    assert sky.companion.binding.hardware.uid == f"{1:016x}"


@pytest.mark.parametrize("flavour", ["px4", SLOW("ardupilot")])
def test_an_autopilot_without_a_hardware_id_is_flown_as_soon_as_any_other(
    flavour: FlavourName,
) -> None:
    """Nothing waits for the answer, and 0 stands for an unknown id."""
    began_s = {}
    for uid in (None, 0):
        sky = in_control(flavour, uid)
        (began_s[uid], _), *_ = [each for each in sky.notes.texts if "in control" in each[1]]
        assert sky.companion.binding.hardware.uid == (None if uid == 0 else f"{1:016x}")
        assert sky.said_of_identity == []
    assert began_s[0] == began_s[None]


@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("uid", [None, pytest.param(0, marks=pytest.mark.slow)])
def test_a_nat_that_binds_another_port_every_ten_seconds_ends_nothing(
    flavour: FlavourName, uid: int | None
) -> None:
    """The search goes on before PX4 misses its setpoints for a second."""
    sky = in_control(flavour, uid)
    for port in range(30_001, 30_004):
        sky.flight.vehicle_peer = ("127.0.0.1", port)
        sky.run(10.0)
        assert sky.companion.binding.peer == sky.flight.vehicle_peer
        assert sky.phase in IN_CONTROL, sky.notes.texts
    assert sky.said_of_identity == []


@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("later_s", [1.5, -1.5])
def test_a_neighbour_that_was_switched_on_with_ours_is_not_flown_while_ours_is_silent(
    flavour: FlavourName, later_s: float
) -> None:
    """Ours has no hardware id, and their clocks are seconds apart."""
    sky = in_control(flavour, 0)
    twin = twin_at_another_address(sky)
    sky.add(msgspec.structs.replace(twin, uptime_s=twin.uptime_s + later_s))
    sky.add(LinkBlackout(duration_s=20.0))
    sky.run(20.0)
    assert sky.phase not in IN_CONTROL
    assert sky.reached.setpoints == []
