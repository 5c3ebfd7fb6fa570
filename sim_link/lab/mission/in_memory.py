"""Flies a mission in lockstep: companion and vehicle in this process, on simulated time.

Theory of operation. Time advances in slices of 0.1 s: the flight runs through one, then the
step runner evaluates the situation and requests the actions that are due. Nothing depends on the
real clock, so the same seed repeats a mission bit by bit.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import msgspec

from companion.domain import FlightMode
from companion.flight_setup import build_endpoint
from companion.mav.dialect import mavlink
from sim_link.lab.faults.fault_models import Schedule
from sim_link.lab.faults.faulty_link import FaultyLink, Injector
from sim_link.lab.lockstep import Flight, MakeCompanion, Makers
from sim_link.lab.lockstep import Operator as Station
from sim_link.lab.mission import results, steps
from sim_link.lab.mission.conditions import FlightSituation
from sim_link.lab.mission.flight_readers import EventReader, rules_of
from sim_link.lab.mission.script import Mission
from sim_link.lab.mission.script_file import flown_config
from sim_link.lab.monitor.monitor import LOCKSTEP, Monitor
from sim_link.lab.observer import Frame, Observer

SLICE_S = 0.1
TRACK_SLICES = 2
"""Number of slices for each point of the track."""
Progress = Callable[[steps.StepRunner, FlightSituation], None]


def fly_in_memory(
    mission: Mission,
    seed: int,
    file: str = "",
    progress: Progress | None = None,
    make_companion: MakeCompanion = build_endpoint,
) -> results.MissionResult:
    """Fly a mission once; `make_companion` may return a modified companion."""
    started, started_cpu = time.perf_counter(), time.process_time()
    flight = _MissionFlight(mission, seed, make_companion)
    flight.fly(progress)
    record = flight.record
    record.wall_s = time.perf_counter() - started
    record.cpu_s = time.process_time() - started_cpu
    how, verdicts = results.how_flown(None, None), results.verdicts_of(mission, record)
    return results.MissionResult(mission, file, seed, how, record, verdicts)


class _MissionFlight:
    def __init__(self, mission: Mission, seed: int, make_companion: MakeCompanion) -> None:
        self.record = results.FlightRecord(autopilot=mission.autopilot.flavour, scope=LOCKSTEP)
        emitters = results.true_positions(mission)
        self._reader = EventReader(self.record, emitters, mission.emitter.emitter_id)
        wire = FaultyLink(Schedule(), seed)
        # PX4's 340 messages per second, most of them unused, take most of the time
        autopilot = msgspec.structs.replace(mission.autopilot, streams="asked")
        flight = Flight(
            flown_config(mission),
            msgspec.structs.replace(mission.scenario, autopilot=autopilot),
            seed,
            self._reader,
            wire=wire,
            makers=Makers(make_companion),
        )
        flight.observers.append(_Watcher(self.record, self._reader))
        self._monitor = Monitor(
            rules_of(flight.config),
            flight.sim.vehicle,
            estimate=lambda: flight.companion.session.estimate,
        )
        flight.observers.append(self._monitor)
        station = Station(flight)
        injector, operator = Injector(flight, wire, station), _Operator(flight, station)
        self._flight = flight
        self._runner = steps.StepRunner(
            mission, self.record, operator, lambda fault, _: injector.add(fault)
        )
        self._slices = 0

    def fly(self, progress: Progress | None) -> None:
        """Fly the mission, from power-on to the last step."""
        flight, runner = self._flight, self._runner
        while True:
            self._look()
            runner.tick(flight.now_s)
            if progress is not None:
                progress(runner, self.record.situation)
            if runner.is_over:
                break
            self._slices += 1
            flight.run(self._slices * SLICE_S - flight.now_s)
        self.record.ended_s = flight.now_s
        self.record.distance_m = flight.sim.vehicle.aircraft.distance_m
        closest_m = self._monitor.fence.closest_m
        self.record.closest_approach_m = closest_m if math.isfinite(closest_m) else None

    def _look(self) -> None:
        """Update the situation from the vehicle's true state."""
        flight, seen = self._flight, self.record.situation.vehicle
        vehicle, now_s = flight.sim.vehicle, flight.now_s
        self._reader.age(now_s)
        flavour = vehicle.flavour
        seen.mode, seen.is_armed = flavour.mode.value, vehicle.is_armed
        seen.is_failsafe, seen.landed = flavour.is_failsafe, flavour.landed_state.name.lower()
        seen.is_ready = vehicle.is_armed or (
            flavour.has_home(vehicle.time_s) and flavour.arming_refusal(vehicle.time_s) is None
        )
        # by the autopilot's estimate, as telemetry has it and as its home is kept
        east_m, north_m, up_m = position = vehicle.aircraft.motion.position_enu_m
        velocity = vehicle.body.velocity_enu_mps
        home = vehicle.home_enu_m
        seen.east_m, seen.north_m, seen.height_m = east_m, north_m, up_m - home[2]
        seen.speed_mps, seen.climb_mps = math.hypot(*velocity[:2]), velocity[2]
        seen.home_distance_m = math.dist(position[:2], home[:2])
        seen.distance_m, seen.battery = vehicle.aircraft.distance_m, vehicle.battery.share
        seen.has_fix = vehicle.estimator.has_fix
        self.record.violations += self._monitor.violations[len(self.record.violations) :]
        self.record.situation.companion.violations = len(self.record.violations)
        if self._slices % TRACK_SLICES == 0:
            self.record.track.append((now_s, vehicle.body.position_enu_m))


class _Watcher(Observer):
    """Keeps and counts messages, and collects the autopilot's texts."""

    def __init__(self, record: results.FlightRecord, reader: EventReader) -> None:
        self._record = record
        self._reader = reader

    def companion_ended(self, now_s: float) -> None:  # noqa: ARG002  the observer's protocol
        """Forget the state that the companion reported."""
        self._reader.restarted()

    def sent(self, frame: Frame) -> None:
        """Handle a frame that the companion sent."""
        self._keep("companion", frame)

    def vehicle_sent(self, frame: Frame) -> None:
        """Handle a frame that the vehicle sent."""
        self._keep("autopilot", frame)
        if frame.number != mavlink.MAVLINK_MSG_ID_STATUSTEXT:  # decoding all would take long
            return
        message = frame.message
        if isinstance(message, mavlink.MAVLink_statustext_message):
            text = str(message.text)
            self._record.texts.append(results.OperatorText(frame.time_s, "autopilot", text))
            self._record.situation.autopilot_texts.append(text)

    def _keep(self, source: str, frame: Frame) -> None:
        self._record.frames.append((frame.time_s, frame.data))
        self._record.messages[source, frame.number] += 1


class _Operator:
    def __init__(self, flight: Flight, station: Station) -> None:
        self._flight = flight
        self._station = station
        self._is_ardupilot = flight.scenario.autopilot.flavour == "ardupilot"

    def ask(self, action: steps.Action) -> None:
        """Carry out an operator's action at the current time of the flight."""
        match action:
            case steps.Request.ARM:
                if self._is_ardupilot:
                    self._station.choose(FlightMode.OFFBOARD)
                self._station.arm()
            case steps.TakeOffAction():
                self._take_off(action.height_m)
            case FlightMode():
                self._station.choose(action)
            case steps.Request.GRANT:
                self._station.grant()

    def take_refusal(self) -> str | None:
        """Return None: refusals are seen in the autopilot's texts."""
        return None

    def _take_off(self, height_m: float) -> None:
        above_m = 0.0 if self._is_ardupilot else self._flight.sim.vehicle.aircraft.home_altitude_m
        rest = [math.nan] * 6 if above_m else [0.0] * 6
        self._station.command(mavlink.MAV_CMD_NAV_TAKEOFF, *rest, above_m + height_m)
