"""What the operator can be asked to do, whoever that is: MAVLink in memory, or MAVSDK."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from companion.domain import FlightMode
from sim_link.faults.kinds import Fault


@dataclass(frozen=True, slots=True)
class Arm:
    """Arm the motors."""


@dataclass(frozen=True, slots=True)
class TakeOff:
    """Take off."""

    height_m: float
    """Above home."""


@dataclass(frozen=True, slots=True)
class SwitchMode:
    """Switch the flight mode."""

    mode: FlightMode


@dataclass(frozen=True, slots=True)
class Grant:
    """Let a companion that yielded stand by again."""


Action = Arm | TakeOff | SwitchMode | Grant


class Operator(Protocol):
    """Whoever holds the ground station."""

    def ask(self, action: Action) -> None:
        """Begin something; the one before is forgotten if it is not over."""

    def take_refusal(self) -> str | None:
        """Why the autopilot refused what was asked last, told once; None: it did not (yet)."""


class Harness(Protocol):
    """Whoever breaks things."""

    def inject(self, fault: Fault, now_s: float) -> None:
        """Have a fault begin `fault.start_s` from now."""
