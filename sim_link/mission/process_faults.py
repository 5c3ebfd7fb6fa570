"""Faults of real processes: the hub's wire, signals, and incidents told to the simulator."""

from __future__ import annotations

import heapq
import signal
from collections.abc import Callable
from functools import partial

import msgspec

from companion.errors import ConfigError
from sim_link.faults.faulty_link import FaultyLink
from sim_link.faults.injector import incident_of
from sim_link.faults.kinds import (
    CompanionKilled,
    CompanionStalled,
    CompanionTerminated,
    ContentFault,
    Fault,
    LinkFault,
    ProcessFault,
    VehicleFault,
)
from sim_link.mission.children import Child
from sim_link.mission.script import Mission


class ProcessHarness:
    """Injects faults into a flight of real processes.

    Args:
        wire: Between vehicle and companion.
        vehicle: The simulator; None: the vehicle is not ours.
        companion: The companion.
    """

    def __init__(self, wire: FaultyLink, vehicle: Child | None, companion: Child) -> None:
        self._wire = wire
        self._vehicle = vehicle
        self._companion = companion
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
                self._at(start_s, partial(self._companion.signal, signal.SIGSTOP))
                self._at(start_s + duration_s, partial(self._companion.signal, signal.SIGCONT))
            case CompanionTerminated():
                self._at(start_s, self._terminate)
            case VehicleFault():
                self._at(start_s, partial(self._happen, fault))

    def tick(self, now_s: float) -> None:
        """Do what is due."""
        while self._due and self._due[0][0] <= now_s:
            heapq.heappop(self._due)[2]()

    def _at(self, time_s: float, action: Callable[[], None]) -> None:
        self._count += 1
        heapq.heappush(self._due, (time_s, self._count, action))

    def _kill(self) -> None:
        self.is_companion_down = True
        self._companion.signal(signal.SIGKILL)

    def _restart(self) -> None:
        self._companion.stop()
        self._companion.start()
        self.is_companion_down, self.has_restarted_companion = False, True

    def _terminate(self) -> None:
        self.is_companion_down = True
        self._companion.signal(signal.SIGTERM)

    def _happen(self, fault: VehicleFault) -> None:
        if self._vehicle is not None:
            incident = msgspec.json.encode(incident_of(fault))
            self._vehicle.tell(incident.decode("ascii"))


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
        where = f"{name}: $.steps[{number}].inject"
        if isinstance(step, VehicleFault):
            if not is_our_vehicle:
                raise ConfigError(f"{where}: a vehicle that is not ours cannot be broken")
            try:
                incident_of(step)
            except ValueError:
                raise ConfigError(f"{where}: only possible in lockstep") from None
