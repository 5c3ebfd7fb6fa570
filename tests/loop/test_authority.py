"""Pilots, other senders and the autopilot's own troubles, on both autopilots and on bad links."""

from __future__ import annotations

import random
from typing import get_args

import pytest

from companion.config.schema import CompanionConfig
from companion.domain import FlightMode
from companion.guidance.commands import SessionParams
from companion.guidance.control_authority import REGAIN_QUIET_S, Reason
from companion.guidance.phases import IN_CONTROL, Phase
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from companion.mav.endpoint import Chunk
from companion.mav.flight_modes import autopilot_of, mode_of
from sim_link.autopilot.incidents import (
    BatteryCharge,
    EkfPoor,
    GpsLoss,
    OriginShift,
    PilotSticks,
    VehicleFault,
    VehicleReboot,
)
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from sim_link.lab.faults.fault_models import LinkBlackout, ModeFlap, SecondSender
from sim_link.lab.faults.faulty_link import Injector
from sim_link.lab.lockstep import VEHICLE_PEER
from sim_link.lab.observer import Frame, Observer
from tests.loop.loop_helpers import LinkFaults, Loop, flown_once

FLAVOURS: tuple[FlavourName, ...] = get_args(FlavourName)
TICK_S = 0.05
ENDLESS = CompanionConfig(mission=SessionParams(engage="auto", stop_radius_m=0.3))
"""A target that is never found well enough: the search goes on."""
SET_MODE = mavlink.MAV_CMD_DO_SET_MODE
BAD = LinkFaults(loss=0.3, delay_s=0.2)
WORSE = LinkFaults(loss=0.3, delay_s=0.5)
"""Every position is old when it comes: it only holds."""
CLEAN = LinkFaults()


class Yielding(Observer):
    """Record of what the companion sends after another mode was reported."""

    def __init__(self) -> None:
        self.foreign_s: float | None = None
        """Time of the first frame of another mode since control was given."""
        self.late: list[tuple[float, str]] = []
        """Messages sent more than a tick after such a frame."""
        self.is_watching = True

    def watch(self) -> None:
        """Control was given."""
        self.is_watching, self.foreign_s = True, None

    def heard(self, frame: Frame) -> None:
        message = frame.message
        if not isinstance(message, mavlink.MAVLink_heartbeat_message):
            return
        autopilot = autopilot_of(message)
        is_foreign = autopilot and mode_of(message, autopilot) is not FlightMode.OFFBOARD
        if is_foreign and self.foreign_s is None:
            self.foreign_s = frame.time_s

    def sent(self, frame: Frame) -> None:
        message, foreign_s = frame.message, self.foreign_s
        if message is None or foreign_s is None or not self.is_watching:
            return
        is_request = (
            isinstance(message, mavlink.MAVLink_command_long_message)
            and message.command == SET_MODE
        )
        is_setpoint = isinstance(message, mavlink.MAVLink_set_position_target_local_ned_message)
        is_setpoint = is_setpoint and frame.time_s < foreign_s + REGAIN_QUIET_S
        if (is_setpoint or is_request) and frame.time_s > foreign_s + TICK_S:
            self.late.append((frame.time_s, message.get_type()))


@flown_once
def flying(
    flavour: FlavourName = "px4", faults: LinkFaults = CLEAN, seed: int = 1, after_s: float = 6.0
) -> Loop:
    """Return a flight that has been in control for a while."""
    scenario = Scenario(autopilot=AutopilotParams(flavour=flavour))
    loop = Loop(ENDLESS, scenario, seed)
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 60.0)
    for fault in faults.schedule().faults:
        loop.wire.add(fault, loop.now_s)
    loop.run(after_s)
    assert loop.phase in IN_CONTROL, loop.notes.texts
    return loop


def inject(loop: Loop, *faults: VehicleFault | LinkBlackout) -> None:
    injector = Injector(loop.flight, loop.wire, loop.operator)
    for fault in faults:
        injector.add(fault)


def reasons(loop: Loop) -> dict[str, int]:
    counts = loop.companion.session.context.reasons
    return {reason.value: count for reason, count in counts.items()}


# The pilot


@pytest.mark.slow
@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("loss", [0.0, 0.1, 0.3])
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.campaign)])
def test_nothing_follows_the_first_frame_of_another_mode(
    flavour: FlavourName, loss: float, seed: int
) -> None:
    rng = random.Random(f"{flavour}{loss}{seed}")
    loop = flying(flavour, LinkFaults(loss=loss), seed)
    watched = Yielding()
    loop.flight.observers.append(watched)
    modes = [rng.choice([FlightMode.HOLD, FlightMode.RETURN]) for _ in range(3)]
    for mode in (*modes, FlightMode.LAND):
        loop.run(rng.uniform(0.05, 2.0))
        loop.choose(mode, is_reported_at_once=rng.random() < 0.5)
        loop.run_until(lambda: watched.foreign_s is not None, 3.0 if not loss else 10.0)
        loop.run(2.0)
        assert loop.phase not in IN_CONTROL
        assert watched.late == []
        loop.run(4.0)
        if mode is not FlightMode.LAND:
            watched.is_watching = False
            give_again(loop)
            watched.watch()


def give_again(loop: Loop) -> None:
    """The operator hands over control by the switch; on a lossy link people try again."""
    for _ in range(10):
        loop.choose(FlightMode.OFFBOARD)
        loop.run(3.0)
        if loop.phase in IN_CONTROL:
            return
    raise AssertionError(f"control was not given again: {loop.notes.texts[-5:]}")


@pytest.mark.slow
@pytest.mark.parametrize("flavour", FLAVOURS)
def test_a_mode_that_flaps_is_left_alone(flavour: FlavourName) -> None:
    loop = flying(flavour, LinkFaults(delay_s=0.02, jitter_s=0.2))
    watched = Yielding()
    loop.flight.observers.append(watched)
    inject(loop, ModeFlap(period_s=0.7, duration_s=10.0))
    loop.run(13.0)
    assert watched.foreign_s is not None
    assert watched.late == []
    assert loop.phase not in IN_CONTROL
    assert sum("in control" in text for text in loop.notes.texts) <= 2


@pytest.mark.slow
@pytest.mark.parametrize("flavour", FLAVOURS)
def test_a_pilot_who_moves_the_sticks_gets_the_vehicle(flavour: FlavourName) -> None:
    loop = flying(flavour)
    inject(loop, PilotSticks(start_s=5.0, forward=0.8, duration_s=10.0))
    loop.run(5.0)
    asked = loop.commands.copy()
    assert loop.run_until(lambda: loop.phase is Phase.HOLD, 1.0) <= 0.4
    assert loop.run_until(lambda: loop.phase is Phase.YIELD, 2.0) <= 1.0
    assert loop.said("control yielded: pilot moves the sticks")
    gave_s = loop.now_s
    loop.run(5.0)
    assert loop.setpoints_since(gave_s) == []
    assert [n for _, n in loop.commands[len(asked) :] if n == SET_MODE] == []


# Other senders, and links that do not carry our setpoints


@pytest.mark.slow
@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize(
    ("faults", "rate_hz", "limit_s"), [(CLEAN, 7.0, 10.0), (CLEAN, 33.0, 4.0), (BAD, 33.0, 10.0)]
)
def test_a_second_sender_is_given_way_to(
    flavour: FlavourName, faults: LinkFaults, rate_hz: float, limit_s: float
) -> None:
    loop = flying(flavour, faults)
    inject(loop, SecondSender(rate_hz=rate_hz, east_m=60.0, north_m=-40.0, duration_s=8.0))
    loop.run_until(lambda: loop.phase is Phase.HOLD, limit_s)
    held_s = loop.now_s
    loop.run_until(lambda: loop.phase is Phase.YIELD, 5.0)
    assert loop.now_s - held_s >= 0.9
    assert loop.said("control yielded: second source of setpoints")
    assert reasons(loop)[Reason.SECOND_SOURCE.value] == 1
    loop.run(0.1)
    gave_s = loop.now_s
    loop.run(10.0)
    assert loop.setpoints_since(gave_s) == []


@pytest.mark.slow
@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize(
    ("rate_hz", "limit_s"), [(1.0, 9.0), (2.0, 5.0), (5.0, 3.0), (10.0, 2.0), (20.0, 2.0)]
)
def test_a_second_sender_in_step_with_us_is_given_way_to(
    flavour: FlavourName, rate_hz: float, limit_s: float
) -> None:
    """Its setpoints always stand for half of our period, so the same few echoes show them."""
    loop = flying(flavour, after_s=6.0 + 0.5 * TICK_S)
    inject(loop, SecondSender(rate_hz=rate_hz, east_m=60.0, north_m=-40.0, duration_s=30.0))
    loop.run_until(lambda: loop.phase is Phase.HOLD, limit_s)
    loop.run_until(lambda: loop.phase is Phase.YIELD, 5.0)
    assert loop.said("control yielded: second source of setpoints")


@pytest.mark.slow
@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("faults", [BAD, WORSE], ids=["0.2 s late", "0.5 s late"])
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.campaign)])
def test_a_bad_link_raises_no_alarm(flavour: FlavourName, faults: LinkFaults, seed: int) -> None:
    loop = flying(flavour, faults, seed)
    loop.run(60.0)
    contention = {Reason.SECOND_SOURCE, Reason.SETPOINTS_LOST, Reason.NO_ECHO}
    assert not contention & {Reason(reason) for reason in reasons(loop)}


@pytest.mark.slow
def test_setpoints_that_do_not_arrive_are_announced() -> None:
    """PX4 leaves offboard then; ArduPilot says nothing."""
    loop = flying("ardupilot")
    inject(loop, LinkBlackout(direction="to_vehicle", duration_s=10.0))
    assert loop.run_until(lambda: loop.phase is Phase.HOLD, 3.0) <= 2.6
    assert loop.said("hold: setpoints not received for 2 s")
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 10.0)


# The autopilot's own troubles


@pytest.mark.slow
@pytest.mark.parametrize("flavour", FLAVOURS)
def test_an_estimator_that_doubts_is_held_on_and_then_handed_back(flavour: FlavourName) -> None:
    loop = flying(flavour)
    inject(loop, EkfPoor(duration_s=20.0))
    if flavour == "ardupilot":  # lands by itself after a second
        loop.run_until(lambda: loop.phase is Phase.YIELD, 1.5)
        return
    loop.run_until(lambda: loop.phase is Phase.HOLD, 1.5)
    loop.run_until(lambda: loop.phase is Phase.YIELD, 5.0)
    loop.run(1.0)
    assert loop.said("handing back: autopilot's position estimate is poor for 5 s")
    assert loop.mode is FlightMode.HOLD


@pytest.mark.slow
@pytest.mark.parametrize("flavour", FLAVOURS)
def test_a_lost_fix_is_held_on_within_a_second(flavour: FlavourName) -> None:
    loop = flying(flavour)
    inject(loop, GpsLoss(duration_s=3.0))
    assert loop.run_until(lambda: loop.phase is Phase.HOLD, 1.0) <= 0.5
    loop.run(5.0)
    assert loop.phase is Phase.NORMAL


@pytest.mark.slow
@pytest.mark.parametrize("flavour", FLAVOURS)
def test_a_low_battery_ends_the_search_in_good_order(flavour: FlavourName) -> None:
    loop = flying(flavour)
    inject(loop, BatteryCharge(share=0.18))
    loop.run_until(lambda: bool(loop.notes.results), 25.0)
    loop.run(2.0)
    assert loop.said("battery low, 18 %")
    assert loop.said("SEARCH ENDED, battery low:")
    assert loop.mode is FlightMode.RETURN


@pytest.mark.slow
def test_a_low_charge_that_is_raised_in_flight_ends_the_search() -> None:
    loop = flying("px4")
    inject(loop, BatteryCharge(share=0.48))
    loop.run(3.0)
    assert loop.phase is Phase.NORMAL
    change = mavlink.MAVLink_param_set_message(1, 191, b"CMP_BAT_LOW", 50.0, 9)
    loop.companion.receive(
        Chunk(0, MavCodec(255, 190).encode(change), VEHICLE_PEER), loop.flight.now_s
    )
    loop.run_until(lambda: bool(loop.notes.results), 25.0)
    assert loop.said("parameter CMP_BAT_LOW: 20 -> 50")
    assert loop.said("SEARCH ENDED, battery low:")


@pytest.mark.slow
@pytest.mark.parametrize("flavour", FLAVOURS)
def test_a_critical_battery_is_handed_back_once(flavour: FlavourName) -> None:
    loop = flying(flavour)
    asked = len(loop.commands)
    inject(loop, BatteryCharge(share=0.09))
    loop.run_until(lambda: loop.phase is Phase.YIELD, 5.0)
    loop.run(2.0)
    assert loop.mode is FlightMode.RETURN
    assert [n for _, n in loop.commands[asked:]].count(SET_MODE) == 1


@pytest.mark.slow
@pytest.mark.parametrize("flavour", FLAVOURS)
def test_an_origin_that_moved_is_held_on_for_two_seconds(flavour: FlavourName) -> None:
    loop = flying(flavour)
    inject(loop, OriginShift(east_m=10.0))
    loop.run_until(lambda: loop.said("local origin moved 10 m"), 20.0)
    assert loop.run_until(lambda: loop.phase is Phase.NORMAL, 5.0) >= 1.9


class FirstWord(Observer):
    """Record of the time of the first message of a restarted vehicle."""

    def __init__(self) -> None:
        self.time_s: float | None = None
        self._has_restarted = False

    def vehicle_rebooted(self, now_s: float) -> None:
        del now_s
        self._has_restarted = True

    def heard(self, frame: Frame) -> None:
        if self._has_restarted and self.time_s is None and frame.sender == (1, 1):
            self.time_s = frame.time_s


@pytest.mark.slow
@pytest.mark.parametrize("down_s", [0.2, 0.9, 1.5, 4.0])
@pytest.mark.parametrize("flavour", FLAVOURS)
def test_a_reboot_is_known_within_a_second_of_its_first_frame(
    flavour: FlavourName, down_s: float
) -> None:
    loop, first = flying(flavour), FirstWord()
    loop.flight.observers.append(first)
    inject(loop, VehicleReboot(down_s=down_s))
    loop.run_until(lambda: loop.said("autopilot restarted"), 10.0)
    assert first.time_s is not None
    assert loop.now_s - first.time_s <= 1.0
    assert loop.phase not in IN_CONTROL
    loop.run(5.0)
    assert sum("autopilot restarted" in text for _, text in loop.notes.texts) == 1


@pytest.mark.slow
@pytest.mark.parametrize("flavour", FLAVOURS)
def test_a_reboot_drops_everything_and_waits_for_the_operator(flavour: FlavourName) -> None:
    loop = flying(flavour)
    asked = len(loop.commands)
    inject(loop, VehicleReboot())
    loop.run_until(lambda: loop.phase not in IN_CONTROL, 4.0)
    ended_s = loop.now_s
    loop.run(60.0)
    assert loop.said("autopilot restarted")
    assert loop.phase is Phase.STANDBY
    assert SET_MODE not in [n for _, n in loop.commands[asked:]]
    if flavour == "ardupilot":
        assert loop.setpoints_since(ended_s) == []
