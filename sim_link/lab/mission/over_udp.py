"""Flies a mission with real processes over UDP, the operator's side through MAVSDK.

Theory of operation. The companion is the `companion` command in a process of its own. The vehicle
is `sim-link` in another, or a vehicle on a given link. Between them is the hub, in this process: it
shares the vehicle's one link among companion, operator and radio, keeps the `.tlog`, injects the
faults of the link, and looks at the mission ten times a second of flight. Everything starts before
the first frame is passed on, so the mission's time is the companion's.
"""

from __future__ import annotations

import asyncio
import shutil
import signal
import tempfile
import time
from collections import namedtuple
from collections.abc import Callable
from pathlib import Path

import msgspec
import yaml

from companion.domain import FlightMode
from companion.errors import CompanionError
from companion.io.child_processes import HOST, START_S, ChildProcess, Pacer, free_udp_ports
from companion.io.links.transports import Transport, UdpBind, UdpConnect, parse_transport
from companion.io.log_files import TlogWriter
from companion.io.shell import Clock, Shell
from sim_link.lab.faults.fault_models import Schedule
from sim_link.lab.faults.faulty_link import FaultyLink
from sim_link.lab.mission.flight_readers import EventReader, EventTail, TelemetryReader, WireWatch
from sim_link.lab.mission.in_memory import Progress
from sim_link.lab.mission.processes import (
    COMPANION,
    RADIO,
    VEHICLE,
    Hub,
    MavsdkOperator,
    ProcessHarness,
)
from sim_link.lab.mission.results import (
    FlightRecord,
    MissionResult,
    how_flown,
    true_positions,
    verdicts_of,
)
from sim_link.lab.mission.script import Mission, PilotOverrideStep
from sim_link.lab.mission.script_file import flown_config
from sim_link.lab.mission.steps import READY, StepRunner
from sim_link.lab.observer import Frame, Lane

SILENCE_S = 15.0
"""Real time without any frame of the vehicle after which the mission is given up."""
HAND_BACK_S = 3.0
"""Real time that the companion may take to hand the vehicle back."""
HOME_S = 5.0
"""Real time for a request of an external vehicle to return after a failed mission."""
MID_THROTTLE_US = range(1400, 1601)
"""Throttle at which neither autopilot climbs or sinks by sticks, in its dead zone."""
TRANSMITTER_S = 10.0
"""Mission time by which the companion has also requested the sticks."""
Ports = namedtuple("Ports", "vehicle simulator companion operator radio")
"""UDP ports of this machine for one flight; the hub hears a simulated vehicle on the first."""


def fly_over_udp(
    mission: Mission,
    seed: int,
    file: str = "",
    *,
    speed: float = 1.0,
    connect: str | None = None,
    keep: Path | None = None,
    progress: Progress | None = None,
) -> MissionResult:
    """Fly a mission once, at `speed` times real time or as fast as this computer allows.

    The speed of a vehicle at `connect` cannot be changed; that of a simulated one is lowered.
    The seed is that of a simulated vehicle, which is started unless a link to `connect` to is
    given, its radio and its faults. `keep` is a folder for `.tlog`, event log and output of the
    processes. `progress` is called after every look. `CompanionError`: a process or link does not
    start.
    """
    with tempfile.TemporaryDirectory(prefix="mission-") as temporary:
        folder = Path(temporary) if keep is None else keep
        folder.mkdir(parents=True, exist_ok=True)
        clock = Clock(speed) if connect else Pacer(Path(temporary) / "clock", speed)
        flight = _UdpFlight(mission, seed, folder, clock, connect)
        started = time.perf_counter()
        try:
            asyncio.run(flight.fly(progress))
        finally:
            flight.close()
        flight.record.wall_s = time.perf_counter() - started
        flight.judge()
    how = how_flown(speed, connect)
    verdicts = () if flight.record.skipped else verdicts_of(mission, flight.record)
    return MissionResult(mission, file, seed, how, flight.record, verdicts)


class _UdpFlight:
    def __init__(
        self, mission: Mission, seed: int, folder: Path, clock: Clock, connect: str | None
    ) -> None:
        self.record = FlightRecord()
        self._mission, self._seed, self._folder = mission, seed, folder
        self._clock, self._speed, self._connect = clock, clock.speed, connect
        self._pacer = clock if isinstance(clock, Pacer) else None
        self._ports = Ports(*free_udp_ports(5))
        self._flights = folder / "flights"
        self._tail = EventTail(self._flights)
        self._offset_s: float | None = None
        """The mission's time minus the companion's."""
        self._reader = EventReader(self.record, true_positions(mission), mission.emitter.emitter_id)
        self._telemetry = TelemetryReader(self.record)
        self._wire = FaultyLink(Schedule(), seed)
        self._companion = self._companion_child()
        self._vehicle = self._vehicle_child() if connect is None else None
        self._radio: ChildProcess | None = None
        self._operator = MavsdkOperator(self._ports.operator, folder / "mavsdk.log")
        self._watched = WireWatch(self._speed)
        recording = self._watched.recording
        self._harness = ProcessHarness(self._wire, self._vehicle, self._companion, recording)
        self._runner = StepRunner(mission, self.record, self._operator, self._harness.inject)
        self._hub = Hub(
            self._wire,
            self._watch,
            self._look,
            self._interrupt,
            has_radio=connect is not None,
            delivered=lambda data, at_s: recording.heard(Frame(at_s, data, Lane.TO_COMPANION)),
        )
        self._end_wall_s: float | None = None
        self._is_stop_requested = False
        self._started_unix_s = time.time()
        (folder / "flight.tlog").unlink(missing_ok=True)  # an earlier mission's; it is appended to
        shutil.rmtree(folder / "state", ignore_errors=True)
        self._tlog = TlogWriter(folder / "flight.tlog")
        self._heard_wall_s = time.monotonic()
        self._progress: Progress | None = None

    async def fly(self, progress: Progress | None) -> None:
        """Fly the mission, from starting the processes to the last step."""
        self._progress = progress
        self._companion.start()
        words = "the companion"  # its flight's folder: it compiles before its clock starts
        await self._await_start(self._companion, self._tail.look_for_flight, words)
        child = self._vehicle
        if child is None:  # a vehicle of others has no radio
            follow = f"udpin:{HOST}:{self._ports.radio}"
            child = self._sim_link_child("radio", "radio.log", "radio", "--follow", follow)
            self._radio = child
        child.start()
        await self._await_start(child, lambda: bool(child.first_words), child.name)
        async with self._operator:
            self._clock.restart()
            self._started_unix_s = time.time()
            self._heard_wall_s = time.monotonic()
            shell = Shell(self._hub, self._links(), self._clock)
            await shell.run()

    def close(self) -> None:
        """End the processes and sockets of the flight."""
        for child in (self._companion, self._radio, self._vehicle):
            if child is not None:
                child.stop()
        self._take_events(self._clock.now_s())
        self._tlog.close()

    def judge(self) -> None:
        """Look for violations of the invariants in the recording."""
        self._watched.date_events(self._offset_s)
        self._watched.judge(flown_config(self._mission), self.record)
        self.record.situation.companion.violations = len(self.record.violations)

    def _links(self) -> list[Transport]:
        ports = self._ports
        vehicle: Transport = UdpBind(HOST, ports.vehicle)
        if self._connect is not None:
            vehicle = parse_transport(self._connect)
        links = [vehicle, UdpConnect(HOST, ports.companion), UdpConnect(HOST, ports.operator)]
        return links if self._connect is None else [*links, UdpConnect(HOST, ports.radio)]

    def _companion_child(self) -> ChildProcess:
        config = flown_config(self._mission)
        log = msgspec.structs.replace(config.log, directory=str(self._flights))
        state = str(self._folder / "state")  # a checkpoint of another flight means nothing here
        process = msgspec.structs.replace(config.process, state_directory=state)
        path = self._folder / "companion.yaml"
        _write_yaml(path, msgspec.structs.replace(config, log=log, process=process))
        arguments = ["-m", "sim_link.lab.supervised_companion", "--config", str(path)]
        arguments += ["--connect", f"udpin:{HOST}:{self._ports.companion}"]
        arguments += ["--speed", f"{self._speed:g}"]
        return ChildProcess(
            "companion", arguments, self._folder / "companion.log", self._clock_variable(0)
        )

    def _vehicle_child(self) -> ChildProcess:
        addresses = ["--listen", f"{HOST}:{self._ports.simulator}"]
        addresses += ["--send-to", f"{HOST}:{self._ports.vehicle}"]
        return self._sim_link_child("sim-link", "vehicle.log", *addresses)

    def _sim_link_child(self, name: str, log: str, *arguments: str) -> ChildProcess:
        path = self._folder / "scenario.yaml"
        _write_yaml(path, self._mission.scenario)
        options = ["--stop-on-eof", "--scenario", str(path), "--seed", str(self._seed)]
        options += ["--speed", f"{self._speed:g}"]
        arguments = ("-m", "sim_link", *arguments, *options)
        return ChildProcess(name, arguments, self._folder / log, self._clock_variable(1))

    def _clock_variable(self, number: int) -> dict[str, str]:
        return {} if self._pacer is None else self._pacer.environment(number)

    async def _await_start(
        self, child: ChildProcess, has_started: Callable[[], bool], name: str
    ) -> None:
        """Wait for a process; `CompanionError`: it ended, or takes too long."""
        deadline = time.monotonic() + START_S
        while not has_started():
            self._report_progress()
            if not child.is_alive or time.monotonic() > deadline:
                words = child.last_words.removeprefix("companion: ")
                raise CompanionError(f"{name} did not start: {words}")
            await asyncio.sleep(0.02)

    def _watch(self, link: int, frame: bytes, now_s: float) -> None:
        self._tlog.write(frame, self._started_unix_s + now_s)
        if link in (VEHICLE, RADIO):
            self._heard_wall_s = time.monotonic()
            self._telemetry.take(frame, now_s)
            self._watched.recording.vehicle_sent(Frame(now_s, frame, Lane.TO_COMPANION))
        elif link == COMPANION:
            self._watched.recording.sent(Frame(now_s, frame, Lane.TO_VEHICLE))
            self._telemetry.take_companion(frame)

    def _look(self, now_s: float) -> None:
        self._watched.looked(now_s)
        if self._pacer is not None:
            if not self._harness.is_companion_running or self._end_wall_s is not None:
                self._pacer.exclude_others()
            if self._pacer.pace != f"{self._speed:g}x":
                self.record.slowed_to = self._pacer.pace
        self._take_events(now_s)
        self._reader.age(now_s)
        vehicle, operator = self.record.situation.vehicle, self._operator
        heartbeat = self._telemetry.heartbeat
        if heartbeat is not None:
            operator.autopilot, operator.is_heard = heartbeat.autopilot, True
            self.record.autopilot = heartbeat.autopilot.name.lower()
        operator.is_armed = bool(vehicle.is_armed)
        vehicle.is_ready = operator.is_ready or operator.is_armed
        self._harness.tick(now_s)
        if self._end_wall_s is not None:
            self._end()
            return
        misfit = self._misfit(now_s)
        self.record.skipped = misfit or ""
        self._check_children(now_s)
        if misfit == "":
            self._runner.tick(now_s)
            self._report_progress()
        if self._runner.is_over or self.record.skipped:
            self._begin_end(now_s)

    def _misfit(self, now_s: float) -> str | None:
        """Return the reason why the script does not fit the vehicle; empty: it fits; None: unknown.

        An external vehicle keeps its pilot's transmitter: only the pilot can put the
        throttle where a mode for sticks neither climbs nor sinks; ArduPilot's simulator has it at
        its lowest.
        """
        if self._connect is None or self._operator.is_armed:
            return ""
        flavour, throttle_us = self.record.autopilot, self._telemetry.throttle_us
        steps = (step for _, step in self._mission.named_steps)
        modes = [s.mode for s in steps if isinstance(s, PilotOverrideStep) and s.needs_sticks]
        if flavour and self._mission.misfit(flavour):
            return self._mission.misfit(flavour)
        if not modes or throttle_us in MID_THROTTLE_US or not READY.holds(self.record.situation):
            return ""
        if throttle_us == 0:
            if now_s < TRANSMITTER_S:
                return None
            return f"{modes[0]} mode needs a transmitter, and the autopilot hears none"
        return (
            f"in {modes[0]} mode the throttle stick, now at {throttle_us} us, would not hold the "
            "height: centre it and fly again (ArduPilot SITL, in MAVProxy: rc 3 1500)"
        )

    def _report_progress(self) -> None:
        if self._progress is not None:
            self._progress(self._runner, self.record.situation)

    def _interrupt(self, now_s: float) -> None:
        """Handle a signal: let the companion hand the vehicle back to its hold mode."""
        if self._end_wall_s is None:
            self.record.is_interrupted = True
            self._runner.abandon("interrupted", now_s)
            self._begin_end(now_s)

    def _begin_end(self, now_s: float) -> None:
        self.record.ended_s = now_s
        self._end_wall_s = time.monotonic()

    def _end(self) -> None:
        """Send an external vehicle home, let the companion hand back, then disconnect."""
        began = self._end_wall_s or 0.0
        vehicle, waited_s = self.record.situation.vehicle, time.monotonic() - began
        is_stranded = self._connect is not None and self._runner.failure and vehicle.is_armed
        is_on_its_way = vehicle.mode in ("return", "land") or self.record.is_interrupted
        if is_stranded and not is_on_its_way and waited_s < HOME_S:
            self._operator.ask(FlightMode.RETURN)
            return
        if not self._is_stop_requested:  # a second signal would end it at once
            self._is_stop_requested = True
            self._companion.signal(signal.SIGTERM)
        if not self._companion.is_alive or waited_s > HOME_S + HAND_BACK_S:
            self._hub.finish()

    def _take_events(self, now_s: float) -> None:
        if self._harness.has_restarted_companion and self._tail.look_for_flight():
            self._harness.has_restarted_companion = False
            self._reader.restarted()
            self._watched.date_events(self._offset_s)
            self._offset_s = None
        events = self._tail.take()
        if not events:
            return
        # an event is never read before it happened: the earliest one read is the best clock
        offset_s = now_s - float(events[-1]["t_s"])
        if self._offset_s is None or offset_s < self._offset_s:
            self._offset_s = offset_s
        for event in events:
            time_s, kind = event.pop("t_s"), event.pop("kind")
            self._watched.noted(kind, event, time_s)
            self._reader.record(kind, event, max(0.0, time_s + self._offset_s))

    def _check_children(self, now_s: float) -> None:
        """End the mission if a process or link that it needs is gone."""
        silent_s = time.monotonic() - self._heard_wall_s
        for child in (self._vehicle, self._radio):
            if child is not None and not child.is_alive:
                self._runner.abandon(f"{child.name} ended: {child.last_words}", now_s)
        if not self._companion.is_alive and not self._harness.is_companion_down:
            self._runner.abandon(f"the companion ended: {self._companion.last_words}", now_s)
        if silent_s > SILENCE_S and self._telemetry.system_id is None:
            self._runner.abandon(f"nothing heard of a vehicle for {SILENCE_S:g} s", now_s)


def _write_yaml(path: Path, value: object) -> None:
    path.write_text(yaml.safe_dump(msgspec.to_builtins(value), sort_keys=False), encoding="utf-8")
