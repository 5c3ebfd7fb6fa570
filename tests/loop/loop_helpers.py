"""A flight in lockstep as the loop tests want it: one object with its notes, records and people."""

from __future__ import annotations

import copy
import copyreg
import functools
import math
import struct
import sys
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ParamSpec, TypeVar

import msgspec

from companion.config.schema import CompanionConfig
from companion.domain import FlightMode, PositionEnu
from companion.flight_setup import build_endpoint
from companion.geometry.coordinates import enu_from_ned
from companion.geometry.polygons import Point
from companion.guidance.commands import SessionParams
from companion.guidance.phases import Phase
from companion.link.endpoint import CompanionEndpoint
from companion.link.interface import Journal, LinkRole, LinkSpec
from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.protocols.addressing import Newest
from sim_link.autopilot.scenario import PayloadParams, Scenario
from sim_link.autopilot.vehicle import SimVehicle
from sim_link.lab.faults.fault_models import Fault, LinkDelay, LinkJitter, LinkLoss, Schedule
from sim_link.lab.faults.faulty_link import FaultyLink
from sim_link.lab.lockstep import (
    Flight,
    MakeCompanion,
    Makers,
    MemoryJournal,
    Operator,
)
from sim_link.lab.observer import Frame, Lane, Observer

__all__ = [
    "AUTO",
    "SELDOM",
    "Fault",
    "LinkFaults",
    "Loop",
    "MemoryJournal",
    "Radio",
    "Sent",
    "flown_once",
    "horizontal",
    "outside",
]

AUTO = CompanionConfig(mission=SessionParams(engage="auto"))
SELDOM = PayloadParams(rate_hz=4.0)
"""Payload at a low rate, for flights that do not test the estimate, which is half of the work."""
BOOT_S = 3.0
"""Time after which the simulated autopilot can be armed."""
Radio = Callable[[SimEndpoint, float], bytes | None]
"""Function that returns a radio's bytes at a time from the simulated truth; it has its own link."""


@dataclass(frozen=True, slots=True)
class LinkFaults:
    """Faults of the link between the two, the same in both directions, all the time."""

    loss: float = 0.0
    delay_s: float = 0.0
    jitter_s: float = 0.0

    def schedule(self) -> Schedule:
        faults: list[Fault] = []
        if self.loss:
            faults.append(LinkLoss(share=self.loss))
        if self.delay_s:
            faults.append(LinkDelay(delay_s=self.delay_s))
        if self.jitter_s:
            faults.append(LinkJitter(jitter_s=self.jitter_s))
        return Schedule(faults=tuple(faults))


@dataclass(frozen=True, slots=True)
class Sent:
    """A setpoint as decoded from the companion's bytes."""

    time_s: float
    position_enu_m: PositionEnu
    """Position relative to the autopilot's local origin."""
    vehicle_enu_m: PositionEnu
    """True position of the vehicle."""


class Recorder(Observer):
    """Keeps what the companion wanted and what became of it.

    Args:
        vehicle: The vehicle as it stands at the start.
    """

    def __init__(self, vehicle: SimVehicle) -> None:
        self._vehicle = vehicle
        self.setpoints: list[Sent] = []
        self.commands: list[tuple[float, int]] = []
        """COMMAND_LONG that the companion sent, by number."""
        self.true_positions: list[PositionEnu] = []

    def sent(self, frame: Frame) -> None:
        """Keep a setpoint or a command."""
        message = frame.message
        if isinstance(message, mavlink.MAVLink_command_long_message):
            self.commands.append((frame.time_s, message.command))
            return
        position = self._position(message)
        if position is not None:
            at = self._vehicle.body.position_enu_m
            self.setpoints.append(Sent(frame.time_s, position, at))

    def stepped(self, vehicle: SimVehicle, now_s: float) -> None:  # noqa: ARG002
        """Record the vehicle's position."""
        self._vehicle = vehicle
        self.true_positions.append(vehicle.body.position_enu_m)

    def _position(self, message: Message | None) -> PositionEnu | None:
        match message:
            case mavlink.MAVLink_set_position_target_local_ned_message():
                return enu_from_ned((message.x, message.y, message.z))
            case mavlink.MAVLink_set_position_target_global_int_message():
                return self._vehicle.origin.enu_from_geodetic(
                    message.lat_int / 1e7, message.lon_int / 1e7, message.alt
                )
        return None


class ByteLog(Observer):
    """Both directions as they were sent."""

    def __init__(self) -> None:
        self.companion = bytearray()
        self.vehicle = bytearray()

    def sent(self, frame: Frame) -> None:
        self.companion += frame.data

    def vehicle_sent(self, frame: Frame) -> None:
        self.vehicle += frame.data


class OwnRadio(Observer):
    """A radio on a link of its own, instead of the simulator's."""

    def __init__(self, flight: Flight, send: Radio, period_s: float) -> None:
        self.is_up = True
        self._flight, self._send, self._period_s = flight, send, period_s
        self._due_s = 0.0
        flight.is_ranging_up = False
        flight.observers.append(self)

    def stepped(self, vehicle: SimVehicle, now_s: float) -> None:  # noqa: ARG002
        if now_s < self._due_s - 1e-9:
            return
        self._due_s = now_s + self._period_s
        data = self._send(self._flight.sim, now_s)
        if data is not None and self.is_up:
            self._flight.observers.notify("vehicle_sent", Frame(now_s, data, Lane.RANGING))
            self._flight.post(data, Lane.RANGING)


P = ParamSpec("P")
Flown = TypeVar("Flown")
MAX_BEGINNINGS = 6
FUSED_S = 1.0
"""Measurements of a flight are fused within this long."""


def _newest(values: Newest[Any, Any]) -> tuple[Any, ...]:
    return Newest, (values._most,), None, None, iter(values.items())


copyreg.pickle(struct.Struct, lambda value: (struct.Struct, (value.format,)))
copyreg.pickle(Newest, _newest)


def _constants() -> dict[int, Any]:
    """Return the constants of all modules by identity: a copy has the same, compared by `is`."""
    kept: list[Any] = []
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] in ("companion", "sim_link"):
            values = [value for key, value in vars(module).items() if key.isupper()]
            kept += values
            for value in values:
                kept += value.values() if isinstance(value, dict) else ()
                kept += value if isinstance(value, tuple) else ()
    return {id(value): value for value in kept}


def flown_once(begin: Callable[P, Flown]) -> Callable[P, Flown]:
    """Fly a beginning once for all tests that share its arguments; each continues a copy.

    A copy takes about 20 ms, a take-off half a second. A fit in progress is a generator, which
    cannot be copied: the beginning goes on until it is over, about ten milliseconds. A beginning
    that keeps one nevertheless, as of a companion that was killed, is flown every time.
    """
    flown: OrderedDict[str, Flown] = OrderedDict()

    @functools.wraps(begin)
    def copied(*args: P.args, **kwargs: P.kwargs) -> Flown:
        key = repr((args, sorted(kwargs.items())))
        if key not in flown:
            flown[key] = begin(*args, **kwargs)
            _end_fits(getattr(flown[key], "flight", None))
            if len(flown) > MAX_BEGINNINGS:
                flown.popitem(last=False)
        try:
            return copy.deepcopy(flown[key], _constants())
        except TypeError:
            return flown.pop(key)

    return copied


def _end_fits(flight: Flight | None) -> None:
    """Let time pass until all measurements are fused."""
    if flight is not None and flight.is_companion_up:
        run_until(flight, lambda: not flight.companion.session.is_behind, FUSED_S)


def of_system(config: CompanionConfig, system_id: int) -> CompanionConfig:
    """The configuration of a companion that need not listen for which vehicles there are."""
    vehicle = msgspec.structs.replace(config.vehicle, system_id=system_id)
    return msgspec.structs.replace(config, vehicle=vehicle)


def run_until(flight: Flight, condition: Callable[[], bool], limit_s: float) -> float:
    """Let time pass until a condition holds, or raise a TimeoutError; how long it took."""
    started_s = flight.now_s
    while not condition():
        if flight.now_s - started_s >= limit_s:
            raise TimeoutError(f"the condition did not hold within {limit_s:g} s")
        flight.step()
    return flight.now_s - started_s


def take_off(flight: Flight, operator: Operator, height_m: float = 10.0) -> None:
    """Arm and take off, until the vehicle holds at the end."""
    flight.run(BOOT_S)
    operator.arm()
    up_m = flight.scenario.origin.altitude_m + height_m
    operator.command(mavlink.MAV_CMD_NAV_TAKEOFF, *[math.nan] * 6, up_m)
    run_until(flight, lambda: flight.mode is FlightMode.HOLD, 60.0)


def said(notes: MemoryJournal, part: str) -> bool:
    """Return True if a text to the operator contained a part."""
    return any(part in text for _, text in notes.texts)


def reboot(flight: Flight) -> None:
    """Put a fresh vehicle in its place: at home, on the ground, its clock at zero."""
    flight.sim = SimEndpoint(flight.scenario, flight.seed, flight.now_s)
    flight.observers.notify("vehicle_rebooted", flight.now_s)


class Loop:
    """One flight; `run` lets invented time pass."""

    def __init__(
        self,
        config: CompanionConfig = AUTO,
        scenario: Scenario | None = None,
        seed: int = 1,
        faults: LinkFaults | Schedule | None = None,
        payload_source: Radio | None = None,
        payload_period_s: float = 0.1,
        make_companion: MakeCompanion = build_endpoint,
        *,
        listens: bool = False,
    ) -> None:
        scenario = scenario or Scenario()
        if config.vehicle.system_id is None and not listens:
            config = of_system(config, scenario.system_id)
        schedule = faults.schedule() if isinstance(faults, LinkFaults) else faults
        self.wire = FaultyLink(schedule or Schedule(), seed)
        self.notes = MemoryJournal()

        def beside_a_radio(
            config: CompanionConfig, journal: Journal, links: Sequence[LinkSpec]
        ) -> CompanionEndpoint:
            return make_companion(config, journal, (*links, LinkSpec(LinkRole.RANGING)))

        self.flight = Flight(
            config,
            scenario,
            seed,
            self.notes,
            wire=self.wire,
            makers=Makers(make_companion if payload_source is None else beside_a_radio),
        )
        self.recorder = Recorder(self.flight.sim.vehicle)
        self.bytes = ByteLog()
        self.flight.observers += [self.recorder, self.bytes]
        self._radio = (
            None
            if payload_source is None
            else OwnRadio(self.flight, payload_source, payload_period_s)
        )
        self.operator = Operator(self.flight)
        self.run = self.flight.run
        self.command = self.operator.command
        self.send_to_vehicle: Callable[[Message], None] = self.operator.send
        self.grant = self.operator.grant

    def choose(self, mode: FlightMode, *, is_reported_at_once: bool = False) -> None:
        """Switch the mode; it may be reported to the companion at once.

        ArduPilot does so anyhow, PX4 reports a new mode by its next HEARTBEAT, unless requested.
        """
        self.operator.choose(mode)
        if is_reported_at_once:
            params = [float(mavlink.MAVLINK_MSG_ID_HEARTBEAT), *[0.0] * 6]
            target = (self.flight.scenario.system_id, 1, mavlink.MAV_CMD_REQUEST_MESSAGE, 0)
            self.operator.send(mavlink.MAVLink_command_long_message(*target, *params), None)
            self.flight.settle()

    def take_off(self, height_m: float = 10.0) -> None:
        take_off(self.flight, self.operator, height_m)

    def reboot(self) -> None:
        reboot(self.flight)

    def said(self, part: str) -> bool:
        return said(self.notes, part)

    def run_until(self, condition: Callable[[], bool], limit_s: float) -> float:
        """Let time pass until a condition holds; how long it took."""
        try:
            return run_until(self.flight, condition, limit_s)
        except TimeoutError as error:
            raise AssertionError(f"{error}; last said: {self.notes.texts[-5:]}") from error

    @property
    def now_s(self) -> float:
        return self.flight.now_s

    @property
    def companion(self) -> CompanionEndpoint:
        return self.flight.companion

    @property
    def sim(self) -> SimEndpoint:
        return self.flight.sim

    @property
    def is_link_up(self) -> bool:
        return self.flight.is_link_up

    @is_link_up.setter
    def is_link_up(self, value: bool) -> None:
        self.flight.is_link_up = value

    @property
    def is_ranging_up(self) -> bool:
        return self.flight.is_ranging_up if self._radio is None else self._radio.is_up

    @is_ranging_up.setter
    def is_ranging_up(self, value: bool) -> None:
        if self._radio is None:
            self.flight.is_ranging_up = value
        else:
            self._radio.is_up = value

    # What became of it

    @property
    def setpoints(self) -> list[Sent]:
        return self.recorder.setpoints

    @property
    def commands(self) -> list[tuple[float, int]]:
        """Commands that the companion sent, by number."""
        return self.recorder.commands

    @property
    def true_positions(self) -> list[PositionEnu]:
        return self.recorder.true_positions

    @property
    def companion_bytes(self) -> bytearray:
        return self.bytes.companion

    @property
    def vehicle_bytes(self) -> bytearray:
        return self.bytes.vehicle

    @property
    def phase(self) -> Phase:
        return self.companion.session.phase

    @property
    def mode(self) -> FlightMode:
        """The mode that the vehicle is truly in."""
        return self.flight.mode

    @property
    def error_m(self) -> float:
        """Distance of the estimate from the emitter; infinite without an estimate."""
        estimate = self.companion.session.estimate
        if estimate is None:
            return math.inf
        return math.dist(estimate.position_enu_m, self.flight.scenario.emitter.position_enu_m)

    def setpoints_since(self, time_s: float) -> list[Sent]:
        return [sent for sent in self.setpoints if sent.time_s > time_s]


def outside(positions: list[PositionEnu], east_north_max_m: float) -> list[PositionEnu]:
    """Return the positions outside the square fence of this half-width."""
    return [p for p in positions if max(abs(p[0]), abs(p[1])) > east_north_max_m]


def horizontal(position: PositionEnu) -> Point:
    return position[:2]
