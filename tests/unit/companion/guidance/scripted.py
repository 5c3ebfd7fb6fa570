"""A scripted vehicle: feeds the session its events tick by tick and keeps what it answers."""

from __future__ import annotations

import math
import random
from collections.abc import Mapping
from typing import TypeVar

from companion.config.schema import CompanionConfig, LimitsConfig, PlannerConfig
from companion.domain import (
    Autopilot,
    BatteryLevel,
    FlightMode,
    LandedState,
    PositionEnu,
    RangingMeasurement,
    VehicleState,
)
from companion.estimation.tracker_params import TrackerParams
from companion.estimation.window.window_map import WindowParams
from companion.flight_setup import build_session
from companion.geometry.coordinates import LocalOrigin
from companion.guidance.commands import (
    Announce,
    Command,
    Record,
    ReportResult,
    SendSetpoint,
    SessionParams,
    SetMode,
    WithdrawRequest,
)
from companion.guidance.control import TICK_S
from companion.guidance.emitters import QueueParams
from companion.guidance.events import (
    AutopilotFenceRead,
    BatteryReported,
    Event,
    HeartbeatReceived,
    HomeSet,
    LandedStateChanged,
    OriginSet,
    Outcome,
    RangingReceived,
    RequestAnswered,
    RequestKind,
    TimerFired,
    VehicleMoved,
)
from companion.guidance.phases import Phase
from companion.link.interface import VehicleParams

C = TypeVar("C", bound=Command)
ORIGIN = LocalOrigin(47.4, 8.5, 488.0)
TARGET = (40.0, 30.0, 0.0)
FILTER_ALONE = TrackerParams(window=WindowParams(enabled=False))
"""The window is half of the work of these tests; flights in lockstep have it."""


class ScriptedFlight:
    """A vehicle at (0, 0, 20) that shows what the test sets.

    Args:
        params: Parameters of the mission.
        autopilot: Autopilot named in its heartbeat.
        limits: Limits of every setpoint.
        planner: Planner during contact.
        emitters: Emitters that are searched for, one after the other.
        vehicle: Vehicle that is flown, and form of its setpoints.
    """

    def __init__(
        self,
        params: SessionParams | None = None,
        autopilot: Autopilot = Autopilot.PX4,
        limits: LimitsConfig | None = None,
        planner: PlannerConfig | None = None,
        emitters: QueueParams | None = None,
        vehicle: VehicleParams | None = None,
    ) -> None:
        config = CompanionConfig(
            mission=params or SessionParams(),
            limits=limits or LimitsConfig(),
            planner=planner or PlannerConfig(),
            emitters=emitters or QueueParams(),
            vehicle=vehicle or VehicleParams(),
            estimation=FILTER_ALONE,
        )
        self.session = build_session(config)
        self.now_s = 0.0
        self.autopilot = autopilot
        self.mode = FlightMode.HOLD
        self.is_armed = False
        self.is_ready = True
        self.is_failsafe = False
        self.position_enu_m: PositionEnu = (0.0, 0.0, 20.0)
        self.targets: dict[int, PositionEnu] = {1: TARGET}
        """Emitters that the radio hears, by id."""
        self.bearing_error_rad = 0.0
        """Error of the radio's bearings, besides noise."""
        self.follows = False
        """True if the vehicle is always at the last setpoint."""
        self.has_link = True
        self.has_heartbeat = True
        self.has_position = True
        self.has_ranging = True
        self.reports_landed = autopilot is Autopilot.ARDUPILOT
        """True if it reports by itself that it is in the air once `ready`, and goes on to."""
        self._landed: LandedState | None = None
        """Report that it repeats twice a second once it was given."""
        self._rng = random.Random(1)
        self.log: list[tuple[float, Command]] = []
        self.r95_history: list[tuple[float, float]] = []
        self._heard_s: float | None = None
        self._ticks = 0
        self.session.handle(AutopilotFenceRead(0.0))
        self.session.handle(BatteryReported(0.0, 100.0, BatteryLevel.UNKNOWN))

    def give(self, event: Event) -> list[Command]:
        commands = self.session.handle(event)
        self.log += [(self.now_s, command) for command in commands]
        return commands

    def heartbeat(self) -> list[Command]:
        self._heard_s = self.now_s
        return self.give(
            HeartbeatReceived(
                self.now_s,
                self.autopilot,
                self.mode,
                self.is_armed,
                self.is_ready,
                self.is_failsafe,
            )
        )

    def show(self, mode: FlightMode, *, is_armed: bool = True, is_failsafe: bool = False) -> None:
        """Switch the mode and say so."""
        self.mode, self.is_armed, self.is_failsafe = mode, is_armed, is_failsafe
        self.heartbeat()

    def answer(self, kind: RequestKind, outcome: Outcome = Outcome.ACCEPTED) -> None:
        self.give(RequestAnswered(self.now_s, kind, outcome))

    def report_landed(self, landed: LandedState) -> None:
        """Say whether the vehicle is on the ground."""
        self._landed = landed
        self.give(LandedStateChanged(self.now_s, landed))

    def locate(self, origin: LocalOrigin = ORIGIN) -> None:
        """Report origin and home."""
        self.give(OriginSet(self.now_s, origin))
        self.give(HomeSet(self.now_s, (0.0, 0.0, 0.0)))

    def fly(self, duration_s: float) -> None:
        """Let time pass, 20 ticks a second; heartbeats once a second."""
        for _ in range(round(duration_s / TICK_S)):
            self._ticks += 1
            self.now_s = round(self._ticks * TICK_S, 6)
            if self.has_link:
                self._hear()
            if self.has_ranging and self._ticks % 2 == 0:
                self.measure()
            self.give(TimerFired(self.now_s, self._heard_s))
            if self.session.estimate is not None:
                self.r95_history.append((self.now_s, self.session.estimate.r95_m))

    def skip(self, ticks: int) -> None:
        """Let ticks pass without giving them to the session."""
        self._ticks += ticks

    def move(self, measured_at_s: float) -> None:
        """Report the vehicle's position, where it rests."""
        state = VehicleState(measured_at_s, self.position_enu_m, (0.0, 0.0, 0.0))
        self.give(VehicleMoved(self.now_s, state))

    def measure(self) -> None:
        """One range and bearing of each target, with a metre and two degrees of noise."""
        for emitter_id, target in self.targets.items():
            range_m = math.dist(self.position_enu_m, target) + self._rng.gauss(0.0, 1.0)
            bearing_rad = math.atan2(
                target[1] - self.position_enu_m[1], target[0] - self.position_enu_m[0]
            )
            bearing_rad += self._rng.gauss(0.0, 0.035) + self.bearing_error_rad
            measurement = RangingMeasurement(
                emitter_id=emitter_id,
                measured_at_s=self.now_s,
                range_m=range_m,
                bearing_enu_rad=math.remainder(bearing_rad, 2.0 * math.pi),
            )
            self.give(RangingReceived(self.now_s, measurement))

    def _hear(self) -> None:
        self._heard_s = self.now_s
        if self.has_heartbeat and self._ticks % 20 == 0:
            self.heartbeat()
        if self.reports_landed and self._landed is not None and self._ticks % 10 == 0:
            self.report_landed(self._landed)
        if self.follows and self.setpoints:
            self.position_enu_m = self.setpoints[-1]
        if self.has_position:
            self.move(self.now_s)

    # What it answered

    def sent(self, kind: type[C], since_s: float = -math.inf) -> list[C]:
        return [c for at_s, c in self.log if at_s > since_s and isinstance(c, kind)]

    def records(self, kind: str) -> list[Mapping[str, object]]:
        """Return the records of a kind in the event log."""
        return [c.fields for c in self.sent(Record) if c.kind == kind]

    @property
    def setpoints(self) -> list[PositionEnu]:
        return [c.setpoint.position_enu_m for c in self.sent(SendSetpoint)]

    @property
    def phase(self) -> Phase:
        return self.session.phase

    def is_in(self, *phases: Phase) -> bool:
        """Return True if the session is in one of these phases."""
        return self.phase in phases

    @property
    def texts(self) -> list[str]:
        return [c.text for c in self.sent(Announce)]

    def asked_modes(self, since_s: float = -math.inf) -> list[FlightMode]:
        return [c.mode for c in self.sent(SetMode, since_s)]

    @property
    def guided_name(self) -> str:
        """Name for the operator of the mode that obeys setpoints."""
        return self.session.vehicle.guided_name

    @property
    def results(self) -> list[ReportResult]:
        return self.sent(ReportResult)

    @property
    def has_withdrawn(self) -> bool:
        return bool(self.sent(WithdrawRequest))

    # Ways to a situation

    def ready(self) -> ScriptedFlight:
        """Bring the flight into the air in hold, with all inputs known, and return it."""
        self.is_armed = True
        self.heartbeat()
        if self.session.vehicle.landed is LandedState.UNKNOWN and self.reports_landed:
            self.report_landed(LandedState.IN_AIR)
        self.locate()
        self.fly(1.0)
        return self

    def on_the_ground(self) -> ScriptedFlight:
        """Disarmed where it starts, with everything known."""
        self.position_enu_m = (0.0, 0.0, 0.0)
        self.heartbeat()
        self.report_landed(LandedState.ON_GROUND)
        self.locate()
        self.fly(0.5)
        return self

    def in_control(self) -> ScriptedFlight:
        """Given offboard by the operator, and following the plan."""
        self.ready()
        self.show(FlightMode.OFFBOARD)
        self.fly(1.0)
        assert self.phase is Phase.NORMAL, self.texts
        return self

    def asking_for_offboard(self) -> ScriptedFlight:
        """Launched from the ground by the session itself, up to its last request (PX4)."""
        self.on_the_ground()
        self.answer(RequestKind.ARM)
        self.show(FlightMode.HOLD)
        self.fly(0.1)
        self.answer(RequestKind.TAKE_OFF)
        self.report_landed(LandedState.IN_AIR)
        for tick in range(1, 51):  # it climbs, it does not jump there
            self.position_enu_m = (0.0, 0.0, 0.4 * tick)
            self.fly(TICK_S)
        self.fly(2.0)
        assert FlightMode.OFFBOARD in self.asked_modes()
        return self

    def launched_by_itself(self) -> ScriptedFlight:
        """Launched by the session itself (PX4), and following the plan."""
        self.asking_for_offboard()
        self.answer(RequestKind.SET_MODE)
        self.show(FlightMode.OFFBOARD)
        self.fly(1.0)
        assert self.phase is Phase.NORMAL, self.texts
        return self

    def fly_until_reported(self) -> None:
        """Fly the plan until the target is reported."""
        while not self.results:
            assert self.now_s < 300.0, self.texts
            self.fly(TICK_S)
