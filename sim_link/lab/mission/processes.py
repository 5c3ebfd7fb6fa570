"""Processes of a mission: children, the hub that links them, their faults, and the operator.

Theory of operation. The hub is a router: frames of the vehicle go to all clients, those of a client
to the vehicle and the other clients. It does not know the vehicle's ids; it sends to the address of
the vehicle's latest frame. Between vehicle and companion is a wire, which may be a `FaultyLink`:
the operator's link has no faults. A timer drives the mission. Faults of the processes
are signals, those of the vehicle incidents sent to the simulator.

The operator arms, takes off, switches modes, returns and lands through MAVSDK.
"""

from __future__ import annotations

import asyncio
import heapq
import json
import math
import sched
import signal
from collections.abc import Callable
from contextlib import aclosing, suppress
from pathlib import Path
from typing import Any

import msgspec

from companion.config.loader import read_text
from companion.domain import Autopilot, FlightMode
from companion.errors import CompanionError, ConfigError, how_to_install
from companion.io.child_processes import ChildProcess
from companion.link.autopilot_queries import STREAM_INTERVAL_S
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from companion.mav.endpoint import Address, Chunk
from companion.mav.flight_modes import set_mode_params
from sim_link.autopilot.incidents import IncidentRecord, VehicleFault
from sim_link.lab.faults import fault_models as faults
from sim_link.lab.faults.faulty_link import FaultyLink
from sim_link.lab.mission.script import Mission
from sim_link.lab.mission.script_file import error_at
from sim_link.lab.mission.steps import Action, Request, TakeOffAction
from sim_link.lab.observer import Lane, Observer, Wire

VEHICLE, COMPANION, OPERATOR, RADIO = range(4)
PERIOD_S = 0.1
"""Time between two checks of the mission."""


class Hub:
    """An `Endpoint` between vehicle, companion and, if there is one, a radio besides the vehicle.

    `watch` is called with every frame with its link and the time, `delivered` of what goes to the
    companion; `tick` is called every 0.1 s; after `stop` the mission calls `finish`.
    """

    def __init__(
        self,
        wire: Wire,
        watch: Callable[[int, bytes, float], None],
        tick: Callable[[float], None],
        stop: Callable[[float], None],
        *,
        has_radio: bool = False,
        delivered: Callable[[bytes, float], None] | None = None,
    ) -> None:
        self._wire = wire
        self._watch = watch
        self._tick = tick
        self._stop = stop
        self._delivered = delivered
        self._clients = (COMPANION, OPERATOR, RADIO) if has_radio else (COMPANION, OPERATOR)
        self._splitters = [MavCodec(0, 0) for _ in range(4)]
        self._peers: dict[int, Address] = {}
        self._late: list[tuple[float, int, int, bytes]] = []
        self._count = 0
        self._due_s = 0.0
        self._output: list[Chunk] = []
        self.is_finished = False

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Route arrivals frame by frame."""
        if chunk.peer is not None:
            self._peers[chunk.link] = chunk.peer
        splitter = self._splitters[chunk.link].splitter
        for frame in splitter.split(chunk.data, is_datagram=chunk.is_datagram):
            self._watch(chunk.link, frame, now_s)
            for link in (VEHICLE, *self._clients):
                if link != chunk.link:
                    self._route(frame, chunk.link, link, now_s)

    def _route(self, frame: bytes, source: int, target: int, now_s: float) -> None:
        if target == COMPANION:
            lane = Lane.TO_COMPANION
        elif source == COMPANION and target == VEHICLE:
            lane = Lane.TO_VEHICLE
        else:
            self._send(target, frame, now_s)
            return
        for due_s, data in self._wire.carry(frame, lane, now_s):
            if due_s <= now_s:
                self._send(target, data, now_s)
            else:
                self._count += 1
                heapq.heappush(self._late, (due_s, self._count, target, data))

    def _send(self, link: int, data: bytes, now_s: float) -> None:
        if link == COMPANION and self._delivered is not None:
            self._delivered(data, now_s)
        self._output.append(Chunk(link, data, self._peers.get(link)))

    def handle_timer(self, now_s: float) -> None:
        """Deliver delayed frames, and step the mission when due."""
        while self._late and self._late[0][0] <= now_s:
            _, _, link, data = heapq.heappop(self._late)
            self._send(link, data, now_s)
        if now_s >= self._due_s:
            self._due_s = max(self._due_s + PERIOD_S, now_s)
            self._tick(now_s)

    def next_timer_s(self) -> float:
        """Return the time of the next timer, s."""
        return min(self._due_s, self._late[0][0]) if self._late else self._due_s

    def take_output(self) -> list[Chunk]:
        """Take the datagrams to send."""
        output, self._output = self._output, []
        return output

    def request_stop(self, now_s: float) -> None:
        """Ask the mission to end."""
        self._stop(now_s)

    def finish(self) -> None:
        """End the mission at once."""
        self.is_finished = True


class ProcessHarness:
    """Injects faults into the processes, perhaps without a vehicle; notifies the watcher."""

    def __init__(
        self,
        wire: FaultyLink,
        vehicle: ChildProcess | None,
        companion: ChildProcess,
        watcher: Observer,
    ) -> None:
        self._wire = wire
        self._vehicle = vehicle
        self._companion = companion
        self._watcher = watcher
        self._now_s = 0.0
        self._due = sched.scheduler(lambda: self._now_s, lambda _: None)
        self.is_companion_down = False
        """True while a fault keeps the companion from running."""
        self._suspended_until_s = -math.inf
        self.has_restarted_companion = False

    def inject(self, fault: faults.Fault, now_s: float) -> None:
        """Schedule a fault to begin `fault.start_s` from now."""
        self._wire.add(fault, now_s)
        start_s, at = now_s + fault.start_s, self._due.enterabs
        match fault:
            case faults.CompanionKilled(down_s=down_s):
                at(start_s, 0, self._end, (signal.SIGKILL,))
                at(start_s + down_s, 0, self._restart)
            case faults.CompanionStalled(duration_s=duration_s):
                at(start_s, 0, self._suspend, (duration_s,))
                at(start_s + duration_s, 0, self._companion.signal, (signal.SIGCONT,))
            case faults.CompanionTerminated():
                at(start_s, 0, self._end, (signal.SIGTERM,))
            case IncidentRecord():
                at(start_s, 0, self._apply, (fault,))

    @property
    def is_companion_running(self) -> bool:
        """True if no fault keeps the companion from running."""
        return not self.is_companion_down and self._now_s >= self._suspended_until_s

    def tick(self, now_s: float) -> None:
        """Apply the faults of processes that are due."""
        self._now_s = now_s
        self._due.run(blocking=False)

    def _suspend(self, duration_s: float) -> None:
        self._suspended_until_s = self._now_s + duration_s
        self._watcher.companion_suspended(self._now_s, self._suspended_until_s)
        self._companion.signal(signal.SIGSTOP)

    def _end(self, how: signal.Signals) -> None:
        self.is_companion_down = True
        self._watcher.companion_ended(self._now_s)
        self._companion.signal(how)

    def _restart(self) -> None:
        self._companion.stop()
        self._companion.start()
        self._watcher.companion_started(self._now_s)
        self.is_companion_down, self.has_restarted_companion = False, True

    def _apply(self, incident: IncidentRecord) -> None:
        if self._vehicle is not None:
            fields = msgspec.to_builtins(incident)
            endless = {name for name, value in fields.items() if value == math.inf}
            plain = {name: value for name, value in fields.items() if name not in endless}
            self._vehicle.write_line(json.dumps(plain))


def check_faults(mission: Mission, name: str) -> None:
    """Check, before any process starts, that every fault of a script can be injected."""
    for number, (_, step) in enumerate(mission.named_steps):
        is_incident = isinstance(step, IncidentRecord)
        if isinstance(step, faults.SecurityFault) or (
            isinstance(step, VehicleFault) and not is_incident
        ):
            path, problem = f"$.steps[{number}].inject", "only possible in lockstep"
            raise error_at(read_text(Path(name)), name, path, problem)


def vehicle_fault_of(mission: Mission) -> str:
    """Return the reason why a script cannot fly an external vehicle; empty: none."""
    for number, (name, step) in enumerate(mission.named_steps, 1):
        if isinstance(step, VehicleFault):
            return f"step {number} {name}: a vehicle that is not ours cannot be broken"
    return ""


SEARCH_S = 30.0
"""Real time that an autopilot may take to be found."""
COMPANION_ID = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER
ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
POSITION_RATE_HZ = 1.0 / STREAM_INTERVAL_S[mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED]
"""Rate of the companion's request, because a lower one would slow the stream on a shared link."""


def check_installed() -> None:
    """Check that MAVSDK is installed; a `ConfigError` has the command to install it."""
    try:
        import mavsdk.asyncio  # noqa: F401  only whether it is there
    except ImportError as error:
        text = f"real processes need MAVSDK: {how_to_install('mavsdk')}"
        raise ConfigError(text) from error


class MavsdkOperator:
    """A `MissionOperator`: a ground station on a UDP port of this machine."""

    def __init__(self, port: int, log: Path) -> None:
        self._port = port
        self._log = log
        self._mavsdk: Any = None
        self._action: Any = None
        self._direct: Any = None
        self._system_id = 1
        self._task: asyncio.Task[None] | None = None
        self._watch: asyncio.Task[None] | None = None
        self._refusal: str | None = None
        self.is_ready = False
        """True if the autopilot can be armed and knows its home."""
        self.is_heard = False
        self.autopilot = Autopilot.OTHER
        """Kind of autopilot, by its observer: mode numbers differ between autopilots."""
        self.is_armed = False
        """True while the vehicle is armed; set by its observer."""

    async def __aenter__(self) -> MavsdkOperator:
        from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
        from mavsdk.logging import log_subscribe

        log_subscribe(self._note)
        configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
        self._mavsdk = Mavsdk(configuration)
        await self._mavsdk.__aenter__()
        await self._mavsdk.add_any_connection(f"udpin://127.0.0.1:{self._port}")
        self._watch = asyncio.create_task(self._find())
        return self

    async def __aexit__(self, *_: object) -> None:
        tasks = [task for task in (self._watch, self._task) if task is not None]
        for task in tasks:
            task.cancel()
        for task in tasks:
            with suppress(asyncio.CancelledError, Exception):
                await task
        await self._mavsdk.__aexit__(None, None, None)

    def _note(self, level: Any, message: str, *_: object) -> bool:
        """Keep a remark of MAVSDK; return True, so that MAVSDK prints nothing."""
        with suppress(OSError), self._log.open("a", encoding="utf-8") as file:
            file.write(f"{level.name} {message}\n")
        return True

    def ask(self, action: Action) -> None:
        """Begin a request; the previous one is forgotten."""
        if self._task is not None and not self._task.done():
            return  # still at it: MAVSDK repeats by itself
        self._task = asyncio.create_task(self._do(action))

    def take_refusal(self) -> str | None:
        """Take the reason of the last refusal; None: not refused."""
        refusal, self._refusal = self._refusal, None
        return refusal

    async def _find(self) -> None:
        """Find the autopilot and begin to watch it; raise `CompanionError` without one."""
        from mavsdk.asyncio.plugins.action import ActionAsync
        from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync
        from mavsdk.asyncio.plugins.telemetry import TelemetryAsync

        system = await self._mavsdk.first_autopilot(timeout_s=SEARCH_S)
        if system is None:
            raise CompanionError("MAVSDK found no autopilot")
        self._system_id = await system.get_system_id()
        while not self.is_heard:
            await asyncio.sleep(0.01)
        self._action = ActionAsync(system)
        self._direct = MavlinkDirectAsync(system)
        telemetry = TelemetryAsync(system)
        if self.autopilot is Autopilot.ARDUPILOT:
            await telemetry.set_rate_health(2.0)
            await telemetry.set_rate_home(1.0)
            await telemetry.set_rate_position(2.0)
            await telemetry.set_rate_position_velocity_ned(POSITION_RATE_HZ)
            await telemetry.set_rate_landed_state(2.0)
        async with aclosing(telemetry.subscribe_health()) as updates:
            async for health in updates:
                self.is_ready = bool(health.is_armable and health.is_home_position_ok)

    async def _do(self, action: Action) -> None:
        if self._action is None:
            self._refusal = "MAVSDK has not found the autopilot yet"
            return
        try:
            await self._carry_out(action)
        except Exception as error:  # MAVSDK's errors have no common base
            self._refusal = f"MAVSDK: {error}"

    async def _carry_out(self, action: Action) -> None:
        match action:
            case Request.ARM:
                if self.autopilot is Autopilot.ARDUPILOT:  # elsewhere it wants the throttle low
                    await self._switch(FlightMode.OFFBOARD)
                await self._action.arm()
            case TakeOffAction():
                await self._action.set_takeoff_altitude(action.height_m)
                await self._action.takeoff()
            case Request.GRANT:
                await self._command(COMPANION_ID, mavlink.MAV_CMD_NAV_GUIDED_ENABLE, (1.0,))
            case FlightMode.RETURN:
                await self._action.return_to_launch()
            case FlightMode.LAND:
                await self._action.land()
            case FlightMode() if self.autopilot is Autopilot.OTHER:
                raise CompanionError("only modes of PX4 and ArduPilot are known")
            case FlightMode():
                await self._switch(action)

    async def _switch(self, mode: FlightMode) -> None:
        params = set_mode_params(mode, self.autopilot, is_armed=self.is_armed)
        number = mavlink.MAV_CMD_DO_SET_MODE
        await self._command(mavlink.MAV_COMP_ID_AUTOPILOT1, number, params)

    async def _command(self, component: int, number: int, params: tuple[float, ...]) -> None:
        """Send a COMMAND_LONG and wait for its answer; `CompanionError`: it was refused."""
        from mavsdk.asyncio.plugins.mavlink_direct import MavlinkMessage

        padded = [*params, *[0.0] * (7 - len(params))]
        fields = {
            "target_system": self._system_id,
            "target_component": component,
            "command": number,
            "confirmation": 0,
        } | {f"param{index}": value for index, value in enumerate(padded, 1)}
        message = MavlinkMessage(
            message_name="COMMAND_LONG",
            system_id=0,
            component_id=0,
            target_system_id=self._system_id,
            target_component_id=component,
            fields_json=json.dumps(fields),
        )
        answer = await self._direct.send_command(message)
        result = json.loads(answer.fields_json).get("result")
        if result != ACCEPTED:
            raise CompanionError(f"command {number} was refused with result {result}")
