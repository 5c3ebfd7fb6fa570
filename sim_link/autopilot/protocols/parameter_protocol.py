"""The parameter protocol: list, read, set.

What does not exist is met with silence, and hardly anything is refused: PX4 1.15 stores a NaN and
what is out of range, and refuses another type in silence; ArduCopter 4.5 lets integers wrap, is
silent about NaN and reports only read-only parameters. A parameter is never created.

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
"""Most lists at a time; a client that is not served requests again, as clients do when a list does
not come."""
MAX_BURST = 64
"""Values per call: what a slow caller missed is made up for bit by bit."""


@dataclass(frozen=True, slots=True)
class ParameterProfile:
    """Behaviour of an autopilot in the parameter protocol."""

    encoding: ParamEncoding
    checks_type: bool
    """A PARAM_SET of another type is ignored; otherwise the parameter's own type counts."""
    reports_index_of_named: bool
    """Otherwise a value read or set by name has index 65535."""
    has_hash_check: bool
    stores_nan: bool
    """Otherwise what is no number is ignored without a word."""
    reports_read_only: bool = False
    """True if it answers with the value and a text; otherwise it is silent."""
    echoes: int = 1
    """Number of times that a changed value is sent."""
    list_rate_hz: float = 1000.0


FENCE_TOTAL = "FENCE_TOTAL"
"""Number of items in ArduPilot's fence; its loader sets and saves it with every other fence."""


@dataclass(slots=True)
class _Listing:
    """A list on its way to one channel."""

    started_s: float
    sent: int = 0


class Parameters:
    """Serves one vehicle's parameters to all channels."""

    def __init__(self, store: ParameterStore, rules: ParameterProfile, texts: StatusTexts) -> None:
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
                value = self._read(message)
                return [] if value is None else [Outgoing(value, partner.channel)]
            case mavlink.MAVLink_param_set_message():
                return self._set(message, partner)
        return []

    def handle_timer(self, now_s: float) -> list[Outgoing]:
        """Return the values of running lists that are due."""
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

    def count_fence(self, items: int) -> list[Outgoing]:
        """Return FENCE_TOTAL of an autopilot that has it, broadcast when it is set."""
        index = self.store.index_of(FENCE_TOTAL)
        if index is None:
            return []
        self.store.set(FENCE_TOTAL, min(items, self.store.specs[index].maximum or items))
        return [Outgoing(self._value(index, is_named=True))]

    @property
    def _list_length(self) -> int:
        return len(self.store) + self._rules.has_hash_check

    def _listed(self, place: int) -> Message:
        if not self._rules.has_hash_check:
            return self._value(place)
        return self._hash_check() if place == 0 else self._value(place - 1)

    def _value(self, index: int, *, is_named: bool = False) -> Message:
        spec = self.store.specs[index]
        hides_index = is_named and not self._rules.reports_index_of_named
        raw = self.store.raw_at(index, self._rules.encoding)
        shown = NO_INDEX if hides_index else index
        return RawParamValue(spec.name, raw, spec.kind, len(self.store), shown)

    def _hash_check(self) -> Message:
        raw = self.store.hash().to_bytes(4, "little")
        return RawParamValue(HASH_CHECK, raw, ParamType.UINT32, len(self.store), NO_INDEX)

    def _read(self, message: mavlink.MAVLink_param_request_read_message) -> Message | None:
        number, name = message.param_index, message.param_id
        if number != -1:
            return self._value(number) if 0 <= number < len(self.store) else None
        if name == HASH_CHECK and self._rules.has_hash_check:
            return self._hash_check()
        index = self.store.index_of(name)
        return None if index is None else self._value(index, is_named=True)

    def _set(self, message: mavlink.MAVLink_param_set_message, partner: Partner) -> list[Outgoing]:
        name, rules = message.param_id, self._rules
        if name == HASH_CHECK and rules.has_hash_check:
            self._listings.pop(partner.channel, None)  # the client has them all from last time
            return []
        index = self.store.index_of(name)
        if index is None:
            return []
        spec = self.store.specs[index]
        if rules.checks_type and message.param_type != spec.kind:
            return []
        if spec.is_read_only:
            return self._report_read_only(index, partner) if rules.reports_read_only else []
        value = value_from_raw(raw_of(message), spec.kind, rules.encoding)
        if not (math.isfinite(value) or rules.stores_nan):
            return []
        if spec.kind.is_integer:  # as C casts a float to an integer type
            least, greatest = (int(bound) for bound in spec.kind.bounds)
            value = least + (int(value) - least) % (greatest - least + 1)
        self.store.set(name, value)
        return [Outgoing(self._value(index, is_named=True))] * rules.echoes

    def _report_read_only(self, index: int, partner: Partner) -> list[Outgoing]:
        text = f"{self.store.specs[index].name} kept: is read-only"
        return [
            Outgoing(self._value(index, is_named=True)),
            *self._texts.warn(partner, text),
        ]
