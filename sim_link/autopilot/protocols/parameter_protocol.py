"""The parameter protocol: list, read, set.

What is refused is told as the guide wants where the rules say so: with a text, and the value kept
and told to everyone. PX4 1.15 refuses in silence and stores a NaN and what is out of range;
ArduCopter 4.5 stores what is out of range, too, lets integers wrap, is silent about NaN and tells
only of what is read-only. A parameter is never created.

Source: MAVLink developer guide, "Parameter Protocol"; PX4 1.15 and ArduCopter 4.5 as observed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.mav.dialect import Message, mavlink
from companion.mav.param_encoding import (
    ParamEncoding,
    ParamType,
    RawParamValue,
    raw_of,
    value_from_raw,
)
from sim_link.autopilot.protocols.addressing import Channel, Outgoing, Partner, StatusTexts
from sim_link.autopilot.protocols.parameter_store import ParameterStore

NO_INDEX = 0xFFFF
HASH_CHECK = "_HASH_CHECK"
MAX_LISTS = 16
"""At a time; who is not served asks again, as clients do when a list does not come."""
MAX_BURST = 64
"""Values per call: what a slow caller missed is made up for bit by bit."""

DOES_NOT_EXIST = mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST
OUT_OF_RANGE = mavlink.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE
READ_ONLY = mavlink.MAV_PARAM_ERROR_READ_ONLY
TYPE_UNSUPPORTED, TYPE_MISMATCH = 6, 7
"""MAV_PARAM_ERROR_TYPE_UNSUPPORTED and _MISMATCH, which the dialect does not have yet."""


@dataclass(frozen=True, slots=True)
class ParameterRules:
    """How an autopilot speaks of its parameters."""

    encoding: ParamEncoding
    checks_type: bool
    """A PARAM_SET of another type is refused; otherwise the parameter's own type counts."""
    tells_errors: bool
    """PARAM_ERROR and a text for what is refused or does not exist; otherwise silence."""
    tells_index_of_named: bool
    """Otherwise a value read or set by name has index 65535."""
    has_hash_check: bool
    checks_value: bool = True
    """Otherwise what its type can hold is stored; an integer keeps the bits that its type has."""
    stores_nan: bool = True
    """Otherwise what is no number is ignored without a word, if no value is checked."""
    tells_read_only: bool = False
    """By the value and a text even where other errors are not told."""
    echoes: int = 1
    """How often a value that was set is told."""
    list_rate_hz: float = 1000.0


def _wrapped(value: float, kind: ParamType) -> int:
    """A finite number as C casts it to an integer type."""
    least, greatest = (int(bound) for bound in kind.bounds)
    return least + (int(value) - least) % (greatest - least + 1)


@dataclass(slots=True)
class _Listing:
    """A list on its way to one channel."""

    started_s: float
    sent: int = 0


class Parameters:
    """Serves one vehicle's parameters to all channels."""

    def __init__(self, store: ParameterStore, rules: ParameterRules, texts: StatusTexts) -> None:
        self.store = store
        self._rules = rules
        self._texts = texts
        self._listings: dict[Channel, _Listing] = {}

    def handle(self, message: Message, partner: Partner, now_s: float) -> list[Outgoing]:
        """Answer a parameter message that is for us; any other gets no answer."""
        match message:
            case mavlink.MAVLink_param_request_list_message():
                if partner.channel in self._listings or len(self._listings) < MAX_LISTS:
                    self._listings[partner.channel] = _Listing(now_s)
                return []
            case mavlink.MAVLink_param_request_read_message():
                return self._read(message, partner)
            case mavlink.MAVLink_param_set_message():
                return self._set(message, partner)
        return []

    def handle_timer(self, now_s: float) -> list[Outgoing]:
        """The values of running lists that are due."""
        outgoing: list[Outgoing] = []
        for channel, listing in list(self._listings.items()):
            due = math.floor((now_s - listing.started_s) * self._rules.list_rate_hz) + 1
            end = min(due, listing.sent + MAX_BURST, self._list_length)
            outgoing += [
                Outgoing(self._listed(place), channel) for place in range(listing.sent, end)
            ]
            listing.sent = max(end, listing.sent)
            if listing.sent >= self._list_length:
                del self._listings[channel]
        return outgoing

    @property
    def _list_length(self) -> int:
        return len(self.store) + self._rules.has_hash_check

    def _listed(self, place: int) -> Message:
        if not self._rules.has_hash_check:
            return self._value(place)
        return self._hash_check() if place == 0 else self._value(place - 1)

    def _value(self, index: int, *, is_named: bool = False) -> Message:
        spec = self.store.specs[index]
        hides_index = is_named and not self._rules.tells_index_of_named
        raw = self.store.raw_at(index, self._rules.encoding)
        shown = NO_INDEX if hides_index else index
        return RawParamValue(spec.name, raw, spec.kind, len(self.store), shown)

    def _hash_check(self) -> Message:
        raw = self.store.hash().to_bytes(4, "little")
        return RawParamValue(HASH_CHECK, raw, ParamType.UINT32, len(self.store), NO_INDEX)

    def _read(
        self, message: mavlink.MAVLink_param_request_read_message, partner: Partner
    ) -> list[Outgoing]:
        if message.param_index != -1:
            if 0 <= message.param_index < len(self.store):
                return [Outgoing(self._value(message.param_index), partner.channel)]
            return self._unknown(partner, "", message.param_index)
        name = message.param_id
        if name == HASH_CHECK and self._rules.has_hash_check:
            return [Outgoing(self._hash_check(), partner.channel)]
        index = self.store.index_of(name)
        if index is None:
            return self._unknown(partner, name, -1)
        return [Outgoing(self._value(index, is_named=True), partner.channel)]

    def _set(self, message: mavlink.MAVLink_param_set_message, partner: Partner) -> list[Outgoing]:
        name = message.param_id
        if name == HASH_CHECK and self._rules.has_hash_check:
            self._listings.pop(partner.channel, None)  # the client has them all from last time
            return []
        index = self.store.index_of(name)
        if index is None:
            return self._unknown(partner, name, -1)
        spec = self.store.specs[index]
        value = value_from_raw(raw_of(message), spec.kind, self._rules.encoding)
        if self._rules.checks_type and message.param_type != spec.kind:
            kinds = {known.kind for known in self.store.specs}
            error = TYPE_MISMATCH if message.param_type in kinds else TYPE_UNSUPPORTED
            return self._refused(partner, index, error, f"is of type {spec.kind.name}")
        problem, rules = spec.problem_with(value), self._rules
        if problem is not None and rules.checks_value:
            return self._refused(partner, index, OUT_OF_RANGE, problem)
        if spec.is_read_only:
            return self._refused(partner, index, READ_ONLY, "is read-only")
        if not (math.isfinite(value) or rules.stores_nan):
            return []
        if spec.kind.is_integer and not rules.checks_value:
            value = _wrapped(value, spec.kind)
        self.store.set(name, value, is_checked=rules.checks_value)
        return [Outgoing(self._value(index, is_named=True))] * self._rules.echoes

    def _refused(self, partner: Partner, index: int, error: int, problem: str) -> list[Outgoing]:
        is_told = self._rules.tells_errors
        if not is_told and not (self._rules.tells_read_only and error == READ_ONLY):
            return []
        name = self.store.specs[index].name
        return [
            Outgoing(self._value(index, is_named=True)),
            *self._texts.warn(partner, f"{name} kept: {problem}"),
            *([self._error(partner, name, index, error)] if is_told else []),
        ]

    def _unknown(self, partner: Partner, name: str, index: int) -> list[Outgoing]:
        if not self._rules.tells_errors:
            return []
        what = name if index == -1 else f"number {index}"
        return [
            *self._texts.warn(partner, f"there is no parameter {what}"),
            self._error(partner, name, index, DOES_NOT_EXIST),
        ]

    @staticmethod
    def _error(partner: Partner, name: str, index: int, error: int) -> Outgoing:
        encoded = name.encode("ascii", errors="replace")
        message = mavlink.MAVLink_param_error_message(*partner.ids, encoded, index, error)
        return Outgoing(message, partner.channel)
