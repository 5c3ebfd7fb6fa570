"""Services of the companion for ground stations: parameters (list, read, set) and commands.

A ground station sees the parameters as those of component 191 next to the vehicle's. A new value is
validated like the configuration, and applied only when that is safe; a refusal reports the value
that is kept and why (PARAM_ERROR, and a text), and nothing is ever created. Integers are encoded
like the autopilot's, bytewise with PX4 and cast with ArduPilot, because ground stations decode all
components of a vehicle in the same way; our AUTOPILOT_VERSION reports which. A broadcast to all
components is answered if the parameter is ours. Every command to us is answered.

Source: MAVLink developer guide, "Parameter Protocol", "Command Protocol"; MAVLink common,
PARAM_ERROR.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from companion.domain import Autopilot
from companion.errors import ConfigError
from companion.guidance.commands import Announce, Severity, Tuning, When
from companion.guidance.events import OperatorCommand, OperatorCommandReceived, Retuned
from companion.link import outbound
from companion.link.executor import SessionExecutor
from companion.link.intake import RateLimit
from companion.mav.dialect import Message, mavlink
from companion.mav.payloads import (
    ParamEncoding,
    ParamType,
    RawParamValue,
    is_for,
    nearest_real32,
    raw_of,
    raw_value,
    value_from_raw,
)

ANSWERS_PER_S = 50
"""Limit of answered reads and changes; a flood of them must not become a flood of answers."""
REFUSALS_PER_S, REFUSAL_BURST = 0.5, 5
"""Rate and burst of texts about refusals; clients retry."""
VALUES_PER_TICK = 2
"""Parameters of a list per tick: on a slow line setpoints have precedence."""
ALL_COMPONENTS = 0

DOES_NOT_EXIST = mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST
OUT_OF_RANGE = mavlink.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE
PERMISSION_DENIED = mavlink.MAV_PARAM_ERROR_PERMISSION_DENIED
READ_ONLY = mavlink.MAV_PARAM_ERROR_READ_ONLY
TYPE_UNSUPPORTED, TYPE_MISMATCH = 6, 7
"""MAV_PARAM_ERROR_TYPE_UNSUPPORTED and _MISMATCH, which the dialect lacks."""
CAPABILITY = {
    ParamEncoding.BYTEWISE: mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE,
    ParamEncoding.C_CAST: mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST,
}

ParamRequest = (
    mavlink.MAVLink_param_request_list_message
    | mavlink.MAVLink_param_request_read_message
    | mavlink.MAVLink_param_set_message
)


@dataclass(frozen=True, slots=True)
class TunableSpec:
    """Parameter as a ground station sees it."""

    name: str
    """Name of up to 16 ASCII characters."""
    kind: ParamType
    when: When


class TunableBook(Protocol):
    """Parameters and their values in the current configuration."""

    @property
    def specs(self) -> Sequence[TunableSpec]:
        """All parameters; names and order never change."""

    def value_at(self, index: int) -> float:
        """Return a value; an `int` for integer types."""

    def change(self, index: int, value: float) -> Tuning:
        """Change a value; return the session's settings. `ConfigError`: refused, none changed."""


class ParameterServer:
    """Server of parameters to ground stations; the executor passes changes to the session."""

    def __init__(self, book: TunableBook, executor: SessionExecutor) -> None:
        self._book = book
        self._executor = executor
        self._outlet = executor.outlet
        self._index = {spec.name: index for index, spec in enumerate(book.specs)}
        self.next_listed: int | None = None
        """Number of the next value of a requested list; None if no list is requested."""
        self._limit = RateLimit(ANSWERS_PER_S, ANSWERS_PER_S)
        self._text_limit = RateLimit(REFUSALS_PER_S, REFUSAL_BURST)

    @property
    def encoding(self) -> ParamEncoding:
        """Encoding of integers in four bytes."""
        is_cast = self._executor.binding.autopilot is Autopilot.ARDUPILOT
        return ParamEncoding.C_CAST if is_cast else ParamEncoding.BYTEWISE

    def receive(self, message: ParamRequest, now_s: float) -> None:
        """Answer a request, if it is for us."""
        if not is_for(message, self._outlet.own_ids):
            return
        if isinstance(message, mavlink.MAVLink_param_request_list_message):
            self.next_listed = 0 if self.next_listed is None else self.next_listed
        elif not self._limit.acquire(now_s):
            return
        elif isinstance(message, mavlink.MAVLink_param_set_message):
            self._set(message, now_s)
        else:
            self._read(message, now_s)

    def send_listed(self, now_s: float) -> None:
        """Send the next values of a requested list."""
        first = self.next_listed
        if first is None:
            return
        end = min(first + VALUES_PER_TICK, len(self._book.specs))
        for index in range(first, end):
            self._send_value(index, now_s)
        self.next_listed = end if end < len(self._book.specs) else None

    def _read(self, message: mavlink.MAVLink_param_request_read_message, now_s: float) -> None:
        number = int(message.param_index)
        if number == -1:
            index = self._index.get(message.param_id)
        else:
            index = number if 0 <= number < len(self._book.specs) else None
        if index is not None:
            self._send_value(index, now_s)
        elif message.target_component != ALL_COMPONENTS:
            name = message.param_id if number == -1 else ""
            self._refuse(message, name, number, DOES_NOT_EXIST, "unknown", now_s)

    def _set(self, message: mavlink.MAVLink_param_set_message, now_s: float) -> None:
        name = message.param_id
        index = self._index.get(name)
        if index is None:
            if message.target_component != ALL_COMPONENTS:
                self._refuse(message, name, -1, DOES_NOT_EXIST, "unknown", now_s)
            return
        refusal = self._change(index, message, now_s)
        self._send_value(index, now_s)
        if refusal is not None:
            self._refuse(message, name, index, *refusal, now_s)

    def _change(
        self, index: int, message: mavlink.MAVLink_param_set_message, now_s: float
    ) -> tuple[int, str] | None:
        """Change a value; return MAV_PARAM_ERROR and the reason if refused, or None."""
        spec = self._book.specs[index]
        is_bytewise = self.encoding is ParamEncoding.BYTEWISE
        if is_bytewise and message.param_type != spec.kind:
            kinds = {known.kind for known in self._book.specs}
            error = TYPE_MISMATCH if message.param_type in kinds else TYPE_UNSUPPORTED
            return error, f"is of type {spec.kind.name}"
        value = value_from_raw(raw_of(message), spec.kind, self.encoding)
        if not math.isfinite(value):
            return OUT_OF_RANGE, "must be a finite number"
        before = self._book.value_at(index)
        if value == (before if spec.kind.is_integer else nearest_real32(before)):
            return None
        objection = self._executor.session.objection_to_change(spec.when)
        if objection is not None:
            return READ_ONLY if spec.when is When.NEVER else PERMISSION_DENIED, objection
        try:
            tuning = self._book.change(index, value)
        except ConfigError as error:
            return OUT_OF_RANGE, str(error)
        self._executor.handle(Retuned(now_s, tuning), now_s)
        after = self._book.value_at(index)
        sender = (message.get_srcSystem(), message.get_srcComponent())
        fields = {"name": spec.name, "old": before, "new": after, "sender": sender}
        self._executor.journal.record("parameter", fields, now_s)
        text = f"parameter {spec.name}: {before:g} -> {after:g}"
        self._outlet.announce(Announce(Severity.NOTICE, text), now_s)
        return None

    def _send_value(self, index: int, now_s: float) -> None:
        spec = self._book.specs[index]
        raw = raw_value(self._book.value_at(index), spec.kind, self.encoding)
        count = len(self._book.specs)
        message = RawParamValue(spec.name, raw, spec.kind, count, index)
        self._outlet.broadcast(message, now_s, is_droppable=True)

    def _refuse(
        self, to: Message, name: str, index: int, error: int, reason: str, now_s: float
    ) -> None:
        message = mavlink.MAVLink_param_error_message(
            to.get_srcSystem(),
            to.get_srcComponent(),
            name.encode("ascii", errors="replace"),
            index,
            error,
        )
        self._outlet.broadcast(message, now_s, is_droppable=True)
        if not self._text_limit.acquire(now_s):
            return
        what = "".join(c if c.isprintable() else "?" for c in name) or f"number {index}"
        text = f"parameter {what}: {reason}"
        self._outlet.announce(Announce(Severity.WARNING, text), now_s)


COMMANDS_PER_S = 20
"""Limit of answered commands; a flood of them must not become a flood of answers."""
REQUEST_CAPABILITIES = 520
"""MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, which older ground stations still send."""
VERSION_ID = mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION

AddressedCommand = mavlink.MAVLink_command_long_message | mavlink.MAVLink_command_int_message
StationRequest = ParamRequest | AddressedCommand


class CommandHandler:
    """Server of commands; the executor passes their effects to the session."""

    def __init__(self, executor: SessionExecutor, parameters: ParameterServer) -> None:
        self._executor = executor
        self._parameters = parameters
        self._outlet = executor.outlet
        self._limit = RateLimit(COMMANDS_PER_S, COMMANDS_PER_S)
        self._text_limit = RateLimit(REFUSALS_PER_S, REFUSAL_BURST)

    def receive(self, message: AddressedCommand, now_s: float, *, may_grant: bool) -> None:
        """Answer a command to this component; with `may_grant` its sender may grant control."""
        if (message.target_system, message.target_component) != self._outlet.own_ids:
            return
        if not self._limit.acquire(now_s):
            return
        result = mavlink.MAV_RESULT_UNSUPPORTED
        if message.command == mavlink.MAV_CMD_NAV_GUIDED_ENABLE:
            result = self._grant(message, now_s, may_grant=may_grant)
        is_version_wanted = _wants_version(message)
        if is_version_wanted:
            result = mavlink.MAV_RESULT_ACCEPTED
        elif message.command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            result = mavlink.MAV_RESULT_DENIED
        sender = message.get_srcSystem(), message.get_srcComponent()
        ack = mavlink.MAVLink_command_ack_message(message.command, result, 0, 0, *sender)
        self._outlet.broadcast(ack, now_s)
        if is_version_wanted:
            version = outbound.autopilot_version(CAPABILITY[self._parameters.encoding])
            self._outlet.broadcast(version, now_s, is_droppable=True)

    def _grant(self, message: AddressedCommand, now_s: float, *, may_grant: bool) -> int:
        """Grant control, or refuse it with a text; return the MAV_RESULT."""
        result, refusal = mavlink.MAV_RESULT_DENIED, None
        if not may_grant:
            refusal = "only from the vehicle's own link"
        elif message.param1 != 1.0:
            refusal = "parameter 1 must be 1"
        else:
            refusal = self._executor.session.objection_to(OperatorCommand.GRANT)
            result = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
        if refusal is None:
            self._executor.handle(OperatorCommandReceived(now_s, OperatorCommand.GRANT), now_s)
            return int(mavlink.MAV_RESULT_ACCEPTED)
        if self._text_limit.acquire(now_s):
            text = f"GRANT refused: {refusal}"
            self._outlet.announce(Announce(Severity.WARNING, text, must_pass=True), now_s)
        return int(result)


def _wants_version(message: AddressedCommand) -> bool:
    """Return True if a command requests AUTOPILOT_VERSION in its current or deprecated form."""
    if message.command == mavlink.MAV_CMD_REQUEST_MESSAGE:
        return bool(message.param1 == VERSION_ID)
    return bool(message.command == REQUEST_CAPABILITIES and message.param1 == 1.0)
