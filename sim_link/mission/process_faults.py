"""Faults of real processes: the hub's wire, signals, and incidents told to the simulator."""

from __future__ import annotations

import heapq
import json
import math
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec

from companion.config.loader import read_text
from sim_link.autopilot.scenario import Incident, WindChange
from sim_link.faults.faulty_link import FaultyLink
from sim_link.faults.host_kinds import (
    CompanionKilled,
    CompanionStalled,
    CompanionTerminated,
    SecurityFault,
)
from sim_link.faults.injector import incident_of
from sim_link.faults.kinds import Fault
from sim_link.faults.vehicle_kinds import VehicleFault, Wind
from sim_link.lockstep.observer import Observer
from sim_link.mission.children import Child
from sim_link.mission.script import Mission
from sim_link.mission.script_file import located


class ProcessHarness:
    """Injects faults into a flight of real processes.

    Args:
        mission: The script, which knows the weather before a fault.
        wire: Between vehicle and companion.
        vehicle: The simulator; None: the vehicle is not ours.
        companion: The companion.
        watcher: Told when the companion's process stops and goes on.
    """

    def __init__(
        self,
        mission: Mission,
        wire: FaultyLink,
        vehicle: Child | None,
        companion: Child,
        watcher: Observer | None = None,
    ) -> None:
        self._mission = mission
        self._wire = wire
        self._vehicle = vehicle
        self._companion = companion
        self._watcher = Observer() if watcher is None else watcher
        self._now_s = 0.0
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._count = 0
        self.is_companion_down = False
        """Whether the companion is meant not to run."""
        self.has_restarted_companion = False

    def inject(self, fault: Fault, now_s: float) -> None:
        """Have a fault begin `fault.start_s` from now."""
        self._wire.add(fault, now_s)
        start_s = now_s + fault.start_s
        match fault:
            case CompanionKilled(down_s=down_s):
                self._at(start_s, self._kill)
                self._at(start_s + down_s, self._restart)
            case CompanionStalled(duration_s=duration_s):
                self._at(start_s, partial(self._suspend, duration_s))
                self._at(start_s + duration_s, partial(self._companion.signal, signal.SIGCONT))
            case CompanionTerminated():
                self._at(start_s, self._terminate)
            case Wind():
                wind = WindChange(east_mps=fault.east_mps, north_mps=fault.north_mps)
                self._at(start_s, partial(self._tell, wind))
                self._at(now_s + fault.end_s, self._calm)
            case VehicleFault():
                self._at(start_s, partial(self._tell, incident_of(fault)))

    def tick(self, now_s: float) -> None:
        """Do what is due."""
        self._now_s = now_s
        while self._due and self._due[0][0] <= now_s:
            heapq.heappop(self._due)[2]()

    def _at(self, time_s: float, action: Callable[[], None]) -> None:
        self._count += 1
        heapq.heappush(self._due, (time_s, self._count, action))

    def _suspend(self, duration_s: float) -> None:
        self._watcher.companion_suspended(self._now_s, self._now_s + duration_s)
        self._companion.signal(signal.SIGSTOP)

    def _kill(self) -> None:
        self.is_companion_down = True
        self._watcher.companion_ended(self._now_s)
        self._companion.signal(signal.SIGKILL)

    def _restart(self) -> None:
        self._companion.stop()
        self._companion.start()
        self._watcher.companion_started(self._now_s)
        self.is_companion_down, self.has_restarted_companion = False, True

    def _terminate(self) -> None:
        self.is_companion_down = True
        self._watcher.companion_ended(self._now_s)
        self._companion.signal(signal.SIGTERM)

    def _calm(self) -> None:
        wind = self._mission.wind
        self._tell(WindChange(east_mps=wind.east_mps, north_mps=wind.north_mps))

    def _tell(self, incident: Incident) -> None:
        if self._vehicle is not None:
            fields = msgspec.to_builtins(incident)
            endless = {name for name, value in fields.items() if value == math.inf}
            plain = {name: value for name, value in fields.items() if name not in endless}
            self._vehicle.tell(json.dumps(plain))


def check_faults(mission: Mission, name: str, *, is_our_vehicle: bool) -> None:
    """Make sure, before anything starts, that every fault of a script can be injected.

    Args:
        mission: The script.
        name: Its file.
        is_our_vehicle: Whether the vehicle is simulated by us.

    Raises:
        ConfigError: One cannot.
    """
    for number, (_, step) in enumerate(mission.named_steps):
        problem = None
        if isinstance(step, SecurityFault):
            problem = "only possible in lockstep"
        elif isinstance(step, VehicleFault) and not is_our_vehicle:
            problem = "a vehicle that is not ours cannot be broken"
        elif isinstance(step, VehicleFault) and not _is_incident(step):
            problem = "only possible in lockstep"
        if problem is not None:
            raise located(read_text(Path(name)), name, f"$.steps[{number}].inject", problem)


def _is_incident(fault: VehicleFault) -> bool:
    try:
        incident_of(fault)
    except ValueError:
        return isinstance(fault, Wind)
    return True
