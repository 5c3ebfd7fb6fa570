"""The client's side of the parameter protocol; values are kept as the bytes on the wire."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

from companion.mav.dialect import mavlink
from sim_link.conformance.rules import (
    Violation,
    require,
)
from sim_link.conformance.station import Heard
from sim_link.conformance.vehicle_probe import VehicleProbe

SERVICE = "MAVLink guide, Parameter Protocol"
STRICT = "(stricter than the real one)"
INT32, REAL32 = 6, 9
PX4_NAMES = (
    "MIS_TAKEOFF_ALT",
    "RTL_RETURN_ALT",
    "COM_OF_LOSS_T",
    "COM_OBL_RC_ACT",
    "MPC_XY_VEL_MAX",
    "SYS_AUTOSTART",
)
ARDUPILOT_NAMES = ("RTL_ALT", "FENCE_ENABLE", "FS_GCS_ENABLE", "GUID_TIMEOUT", "SYSID_MYGCS")
UNLISTED_INDEX = 65_535
Value = mavlink.MAVLink_param_value_message
Error = mavlink.MAVLink_param_error_message
LIST_S = 60.0
ANSWER_S = 2.0


@dataclass(frozen=True, slots=True)
class Parameter:
    """One PARAM_VALUE, its value kept as the four bytes on the wire."""

    name: str
    kind: int
    raw: bytes
    index: int
    count: int

    def value(self, probe: VehicleProbe) -> float:
        """The number, decoded as the flavour encodes."""
        if probe.is_px4 and self.kind == INT32:
            return float(struct.unpack("<i", self.raw)[0])
        return float(struct.unpack("<f", self.raw)[0])


def parameter(entry: Heard) -> Parameter:
    """The parameter of a heard PARAM_VALUE."""
    message = entry.message
    assert isinstance(message, Value)
    start = 10 if entry.frame[0] == 0xFD else 6
    payload = entry.frame[start : start + entry.frame[1]].ljust(25, b"\0")
    return Parameter(
        message.param_id, message.param_type, payload[:4], message.param_index, message.param_count
    )


def encode(probe: VehicleProbe, value: float, kind: int) -> float:
    """The float field that carries a value."""
    if probe.is_px4 and kind == INT32:
        return float(struct.unpack("<f", struct.pack("<i", int(value)))[0])
    return value


def values_since(probe: VehicleProbe, mark: int, name: str | None = None) -> list[Parameter]:
    """The parameters told since a mark."""
    found = [
        parameter(entry)
        for entry in probe.inbox[mark:]
        if isinstance(entry.message, Value) and entry.source == probe.target
    ]
    return [p for p in found if name in (None, p.name)]


def await_value(probe: VehicleProbe, mark: int, name: str) -> Parameter:
    """The next value of a parameter."""
    told = probe.run_until(lambda: bool(values_since(probe, mark, name)), ANSWER_S)
    require(told, f"no PARAM_VALUE of {name} within {ANSWER_S:g} s")
    return values_since(probe, mark, name)[-1]


def read(probe: VehicleProbe, name: str) -> Parameter:
    """PARAM_REQUEST_READ by name."""
    mark = probe.mark
    probe.send(mavlink.MAVLink_param_request_read_message(*probe.target, name.encode(), -1))
    return await_value(probe, mark, name)


def write(
    probe: VehicleProbe, name: str, value: float, kind: int, target: tuple[int, int] | None = None
) -> int:
    """PARAM_SET; the mark before it."""
    mark = probe.mark
    field = encode(probe, value, kind) if math.isfinite(value) else value
    probe.send(
        mavlink.MAVLink_param_set_message(*(target or probe.target), name.encode(), field, kind)
    )
    return mark


def read_all(probe: VehicleProbe) -> list[Parameter]:
    """PARAM_REQUEST_LIST; every parameter once, by index."""
    mark = probe.mark
    probe.send(mavlink.MAVLink_param_request_list_message(*probe.target))
    seen: dict[int, Parameter] = {}
    cursor = mark

    def is_complete() -> bool:
        """Whether every index was told."""
        nonlocal cursor
        for entry in probe.inbox[cursor:]:
            cursor += 1
            if isinstance(entry.message, Value) and entry.source == probe.target:
                told = parameter(entry)
                if told.index != UNLISTED_INDEX:
                    seen[told.index] = told
        return bool(seen) and len(seen) == next(iter(seen.values())).count

    if not probe.run_until(is_complete, LIST_S):
        raise Violation(f"{len(seen)} parameters within {LIST_S:g} s, incomplete")
    return [seen[index] for index in sorted(seen)]


def float_name(probe: VehicleProbe) -> str:
    """A REAL32 parameter that may be changed a little."""
    return "MIS_TAKEOFF_ALT" if probe.is_px4 else "GUID_TIMEOUT"


def integer_name(probe: VehicleProbe) -> str:
    """An integer parameter that may be 3."""
    return "COM_OBL_RC_ACT" if probe.is_px4 else "FS_GCS_ENABLE"
