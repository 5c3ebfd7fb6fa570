"""Conversion of commands to messages: ENU to NED, metres to AMSL and degE7; and requests.

One request at a time is in flight, repeated, and answered or abandoned: without an ACK it is
repeated with `confirmation` + 1, IN_PROGRESS means wait; at most 2 s in all, 10 s with progress,
never a loop.

Source: MAVLink common; PX4 user guide, offboard mode; MAVLink guide, "Command Protocol".
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.domain import Autopilot, FlightMode, PositionSetpoint
from companion.errors import LocalProtocolError
from companion.geometry.coordinates import LocalOrigin
from companion.guidance.commands import TakeOff
from companion.guidance.events import Outcome, RequestAnswered, RequestKind
from companion.mav import dialect
from companion.mav.dialect import Message, mavlink, result_words
from companion.mav.flight_modes import set_mode_params

RESEND_S = 0.5
SENDS = 4
IN_PROGRESS_S = 3.0
MAX_PROGRESS_S = 10.0
"""Time after which an autopilot that only reports progress is taken as not answering."""

Ids = tuple[int, int]
CommandMessage = mavlink.MAVLink_command_long_message


@dataclass(frozen=True, slots=True)
class VehicleCommand:
    """MAV_CMD and its first parameters; the others are zero."""

    number: int
    params: tuple[float, ...]

    def message(self, target: Ids, confirmation: int = 0) -> CommandMessage:
        """Return the COMMAND_LONG; `confirmation` is the number of earlier transmissions."""
        padded = (*self.params, *(0.0,) * (7 - len(self.params)))
        return CommandMessage(*target, self.number, confirmation, *padded)


@dataclass(slots=True)
class _Pending:
    kind: RequestKind
    command: VehicleCommand
    target: Ids
    sends: int = 0
    next_s: float = 0.0
    first_s: float | None = None


class RequestClient:
    """Request in flight; a new one replaces it, because only the latest counts."""

    def __init__(self) -> None:
        self.pending: _Pending | None = None
        """Unanswered request; None without one."""

    def submit(self, kind: RequestKind, command: VehicleCommand, target: Ids) -> None:
        """Start a request with the next call of `due`."""
        self.pending = _Pending(kind, command, target)

    def cancel(self) -> None:
        """Forget the request in flight."""
        self.pending = None

    def due(self, now_s: float) -> Message | RequestAnswered | None:
        """Return the message to send now, the failure of an unanswered request, or None."""
        pending = self.pending
        if pending is None or now_s < pending.next_s:
            return None
        if pending.sends >= SENDS:
            self.pending = None
            return RequestAnswered(now_s, pending.kind, Outcome.NO_ANSWER)
        if pending.first_s is None:
            pending.first_s = now_s
        message = pending.command.message(pending.target, pending.sends)
        pending.sends += 1
        pending.next_s = now_s + RESEND_S
        return message

    def receive_ack(
        self, ack: mavlink.MAVLink_command_ack_message, now_s: float
    ) -> RequestAnswered | None:
        """Return the result of the request in flight by a final ACK of the autopilot, or None."""
        pending = self.pending
        if pending is None or pending.sends == 0 or ack.command != pending.command.number:
            return None  # not sent yet: the answer belongs to a request that was replaced
        if ack.result == mavlink.MAV_RESULT_IN_PROGRESS:
            pending.sends = SENDS
            last_s = now_s if pending.first_s is None else pending.first_s + MAX_PROGRESS_S
            pending.next_s = min(now_s + IN_PROGRESS_S, last_s)
            return None
        self.pending = None
        if ack.result == mavlink.MAV_RESULT_ACCEPTED:
            return RequestAnswered(now_s, pending.kind, Outcome.ACCEPTED)
        name = result_words("MAV_RESULT", ack.result, "MAV_RESULT_")
        is_repeated = pending.sends > 1
        return RequestAnswered(now_s, pending.kind, Outcome.REJECTED, name, is_repeated=is_repeated)


TEXT_LENGTH = 50
MAX_CHUNKS = 4
"""Limit of chunks; a longer text is truncated."""
UINT32 = 0xFFFFFFFF


def time_boot_ms(now_s: float) -> int:
    """Return our clock as a 32-bit stamp, which wraps after 49.7 days."""
    return int(now_s * 1000.0) & UINT32


MARK = b"CMP_ID"
"""Name of the NAMED_VALUE_FLOAT that identifies a companion of this kind."""


def heartbeat() -> Message:
    """Return the HEARTBEAT of an onboard controller without autopilot."""
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
        mavlink.MAV_AUTOPILOT_INVALID,
        0,
        0,
        mavlink.MAV_STATE_ACTIVE,
        3,
    )


def local_setpoint(setpoint: PositionSetpoint, now_s: float, target: Ids) -> Message:
    """Return SET_POSITION_TARGET_LOCAL_NED in frame LOCAL_NED, position with or without yaw."""
    mask, rest = _checked_fields(setpoint)
    east_m, north_m, up_m = setpoint.position_enu_m
    return mavlink.MAVLink_set_position_target_local_ned_message(
        time_boot_ms(now_s),
        *target,
        mavlink.MAV_FRAME_LOCAL_NED,
        mask,
        north_m,
        east_m,
        -up_m,
        *rest,
    )


def global_setpoint(
    setpoint: PositionSetpoint, origin: LocalOrigin, now_s: float, target: Ids
) -> Message:
    """Return SET_POSITION_TARGET_GLOBAL_INT in frame 5 (AMSL); PX4 1.15 misplaces frame 6."""
    mask, rest = _checked_fields(setpoint)
    latitude_deg, longitude_deg, altitude_m = origin.geodetic_from_enu(setpoint.position_enu_m)
    return mavlink.MAVLink_set_position_target_global_int_message(
        time_boot_ms(now_s),
        *target,
        mavlink.MAV_FRAME_GLOBAL_INT,
        mask,
        round(latitude_deg * 1e7),
        round(longitude_deg * 1e7),
        altitude_m,
        *rest,
    )


def _checked_fields(setpoint: PositionSetpoint) -> tuple[int, tuple[float, ...]]:
    """Return the type mask, and the fields after the position: velocity, acceleration, yaw."""
    yaw_rad = setpoint.yaw_ned_rad
    if not all(map(math.isfinite, (*setpoint.position_enu_m, yaw_rad or 0.0))):
        raise LocalProtocolError(f"setpoint {setpoint.position_enu_m} is not finite")
    mask = dialect.POSITION_ONLY if yaw_rad is None else dialect.POSITION_AND_YAW
    return mask, (*(0.0,) * 6, yaw_rad or 0.0, 0.0)


def arm() -> VehicleCommand:
    """Return the command to arm, without force."""
    return VehicleCommand(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, (1.0,))


def set_mode(mode: FlightMode, autopilot: Autopilot, *, is_armed: bool) -> VehicleCommand:
    """Return DO_SET_MODE; raise `KeyError` if the autopilot has no such mode."""
    params = set_mode_params(mode, autopilot, is_armed=is_armed)
    return VehicleCommand(mavlink.MAV_CMD_DO_SET_MODE, params)


def take_off(command: TakeOff, origin: LocalOrigin | None, autopilot: Autopilot) -> VehicleCommand:
    """Return NAV_TAKEOFF to a height above home.

    PX4 reads parameter 7 as AMSL, and NaN as "here" or its own default; ArduPilot reads it above
    home and must not see a NaN.
    """
    if autopilot is Autopilot.ARDUPILOT:
        params = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, command.altitude_m)
    else:
        home_m = math.nan if origin is None else origin.altitude_m + command.home_up_m
        params = (*(math.nan,) * 6, home_m + command.altitude_m)
    return VehicleCommand(mavlink.MAV_CMD_NAV_TAKEOFF, params)


def autopilot_version(param_capability: int) -> Message:
    """Return AUTOPILOT_VERSION of the companion, for its capabilities."""
    return mavlink.MAVLink_autopilot_version_message(
        mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2 | param_capability,
        *(0,) * 4,
        *(bytes(8),) * 3,
        *(0,) * 3,
    )


def status_text(severity: int, text: str, text_id: int) -> list[Message]:
    """Return STATUSTEXTs, one for each chunk of a long text, joined by a non-zero `text_id`."""
    chunks = _chunks(text)
    join_id = 0 if len(chunks) == 1 else text_id
    return [
        mavlink.MAVLink_statustext_message(severity, chunk, join_id, number)
        for number, chunk in enumerate(chunks)
    ]


def _chunks(text: str) -> list[bytes]:
    """Return UTF-8 in whole characters per STATUSTEXT; a NUL ends the last chunk (MAVLink)."""
    chunks = [b""]
    for character in text.encode("utf-8", errors="replace").decode("utf-8"):
        data = character.encode("utf-8")
        if len(chunks[-1]) + len(data) > TEXT_LENGTH:
            if len(chunks) == MAX_CHUNKS:
                break
            chunks.append(b"")
        chunks[-1] += data
    if len(chunks) > 1 and len(chunks[-1]) == TEXT_LENGTH:
        if len(chunks) == MAX_CHUNKS:
            chunks[-1] = chunks[-1].decode("utf-8")[:-1].encode("utf-8")
        else:
            chunks.append(b"")
    return chunks
