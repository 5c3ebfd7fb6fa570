"""Which faults act when."""

from __future__ import annotations

import math

import msgspec

from companion.domain import Params
from sim_link.faults.kinds import Fault
from sim_link.faults.record import FaultRecord


class Schedule(Params, frozen=True):
    """Faults, each with its start and duration, in seconds since the schedule began."""

    faults: tuple[Fault, ...] = ()

    def active(self, time_s: float) -> list[Fault]:
        """What acts at a time."""
        return [fault for fault in self.faults if fault.is_active(time_s)]

    def shifted(self, by_s: float) -> Schedule:
        """The same faults, later by so much."""
        return Schedule(
            faults=tuple(
                msgspec.structs.replace(fault, start_s=fault.start_s + by_s)
                for fault in self.faults
            )
        )

    @property
    def end_s(self) -> float:
        """When the last fault that ends is over; faults without an end do not count."""
        return max((f.end_s for f in self.faults if math.isfinite(f.end_s)), default=0.0)


def fault_from(fields: dict[str, object]) -> Fault:
    """The fault that a mapping names by its `kind`.

    Raises:
        msgspec.ValidationError: No such kind, or fields that it does not have or may not be.
    """
    fault: Fault = msgspec.convert(fields, Fault)
    return fault


def fields_of(fault: FaultRecord) -> dict[str, object]:
    """The mapping that names a fault, without what is as by default."""
    fields = {
        name: value
        for name, value in msgspec.to_builtins(fault).items()
        if name == "kind" or value != _default_of(type(fault), name)
    }
    return dict(fields)


def _default_of(kind: type[FaultRecord], name: str) -> object:
    return msgspec.to_builtins(getattr(kind(), name))
