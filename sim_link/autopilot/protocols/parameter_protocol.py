"""Typed parameters, and the protocol that lists, reads and sets them.

Requests of unknown parameters are not answered, and hardly any value is refused: PX4 1.15 stores a
NaN and what is out of range, and refuses another type in silence; ArduCopter 4.5 lets integers
wrap, is silent about NaN and reports only read-only parameters. A parameter is never created.

Source: MAVLink developer guide, "Parameter Protocol"; PX4 1.15 and ArduCopter 4.5 as observed.

The set is fixed when a store is made, as the guide requires: names and indices never change at run
time. A scenario's value is refused rather than clipped, a client's is not. What differs from the
defaults is kept as lines `NAME VALUE`, the form that ArduPilot's tools write too.
"""

from __future__ import annotations

import csv
import math
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from importlib.resources import files

from companion.errors import ConfigError
from companion.mav.dialect import Message, mavlink
from companion.mav.payloads import (
    NAME_LENGTH,
    ParamEncoding,
    ParamType,
    RawParamValue,
    nearest_real32,
    raw_of,
    raw_value,
    value_from_raw,
)
from sim_link.autopilot.protocols.addressing import Channel, Outgoing, Partner, StatusTexts

COMMENT = "#"


@dataclass(frozen=True, slots=True)
class ParamSpec:
    """Parameter of the autopilot: its type, default and limits."""

    name: str
    kind: ParamType
    default: float
    minimum: float | None = None
    """Minimum value; None: that of its type."""
    maximum: float | None = None
    unit: str = ""
    is_read_only: bool = False
    """True if clients cannot change it; the vehicle itself may."""

    def problem_with(self, value: float) -> str | None:
        """Return the reason why `value` is not allowed, in a few words; None if it is."""
        if not math.isfinite(value):
            return "not a number"
        if self.kind.is_integer and value != int(value):
            return "not a whole number"
        least, greatest = self.bounds
        if not least <= value <= greatest:
            return f"not within {least:g} to {greatest:g} {self.unit}".rstrip()
        return None

    @property
    def bounds(self) -> tuple[float, float]:
        """The smallest and the largest value allowed."""
        least, greatest = self.kind.bounds
        return (
            least if self.minimum is None else self.minimum,
            greatest if self.maximum is None else self.maximum,
        )


def read_rows(package: str, name: str) -> list[dict[str, str]]:
    """Return the rows of a CSV file of a package."""
    text = files(package).joinpath(name).read_text(encoding="utf-8")
    return list(csv.DictReader(text.splitlines()))


def read_specs(package: str) -> tuple[ParamSpec, ...]:
    """Return the parameters in a package's `parameters.csv`, in the order of their indices."""
    return tuple(
        ParamSpec(
            row["name"],
            ParamType[row["type"]],
            float(row["default"]),
            float(row["minimum"]) if row["minimum"] else None,
            float(row["maximum"]) if row["maximum"] else None,
            row["unit"],
            is_read_only=row["access"] == "read",
        )
        for row in read_rows(package, "parameters.csv")
    )


class ParameterStore:
    """The values of parameters, given in the order of their indices.

    `initial` replaces defaults, for example by a vehicle's system id. `ConfigError`: a value is
    impossible, or a name occurs twice.
    """

    def __init__(self, specs: Iterable[ParamSpec], initial: Mapping[str, float] = {}) -> None:
        self.specs = tuple(specs)
        self.revision = 0
        """Rises with every change; a shell saves when it has."""
        self._index = {spec.name: index for index, spec in enumerate(self.specs)}
        if len(self._index) != len(self.specs):
            raise ConfigError("parameters: a name occurs twice")
        self._defaults: list[float] = []
        for spec in self.specs:
            if not 0 < len(spec.name) <= NAME_LENGTH or not spec.name.isascii():
                raise ConfigError(f"parameter `{spec.name}`: needs 1 to 16 ASCII characters")
            value = initial.get(spec.name, spec.default)
            self._defaults.append(_checked(spec, value, f"parameter {spec.name}"))
        for name in initial:
            if name not in self._index:
                raise ConfigError(f"parameter {name}: there is no such parameter")
        self._values = list(self._defaults)

    def __len__(self) -> int:
        return len(self.specs)

    def __getitem__(self, name: str) -> float:
        """Return the value of a parameter that exists; an `int` if its type is whole."""
        return self._values[self._index[name]]

    def index_of(self, name: str) -> int | None:
        """Return the index of a name; None if there is no such parameter."""
        return self._index.get(name)

    def set(self, name: str, value: float) -> None:
        """Change a parameter that exists, read-only or not, to any value that its type can hold."""
        index = self._index[name]
        stored = _stored(self.specs[index], value)
        if stored != self._values[index]:
            self._values[index] = stored
            self.revision += 1

    def raw_at(self, index: int, encoding: ParamEncoding) -> bytes:
        """Return the four wire bytes of the value at an index."""
        return raw_value(self._values[index], self.specs[index].kind, encoding)

    def hash(self) -> int:
        """Return a 32-bit number that changes with any name or value, for PX4's `_HASH_CHECK`."""
        checksum = 0
        for index, spec in enumerate(self.specs):
            checksum = zlib.crc32(spec.name.encode("ascii"), checksum)
            checksum = zlib.crc32(self.raw_at(index, ParamEncoding.BYTEWISE), checksum)
        return checksum

    def to_text(self) -> str:
        """Return the values that differ from their defaults, one per line."""
        lines = [f"{COMMENT} parameters that differ from their defaults"]
        lines += [
            f"{spec.name} {_shortest(value)}"
            for spec, value, default in zip(self.specs, self._values, self._defaults, strict=True)
            if value != default and not spec.is_read_only
        ]
        return "\n".join(lines) + "\n"

    def load_text(self, text: str, where: str) -> None:
        """Take over all values of a text, or none; `ConfigError` names the file and a wrong line.

        Lines are `NAME VALUE`, a comma or any blanks between; `#` begins a comment. A value may be
        beyond its range, because a client could store it.
        """
        values: dict[int, float] = {}
        for number, line in enumerate(text.splitlines(), 1):
            fields = line.partition(COMMENT)[0].replace(",", " ").split()
            if fields:
                index, value = self._parsed(fields, f"{where}, line {number}")
                values[index] = value
        for index, value in values.items():
            self.revision += value != self._values[index]
            self._values[index] = value

    def _parsed(self, fields: list[str], where: str) -> tuple[int, float]:
        if len(fields) != 2:
            raise ConfigError(f"{where}: must be `NAME VALUE`, for example `COM_OF_LOSS_T 1.0`")
        name, number = fields
        index = self._index.get(name)
        if index is None:
            raise ConfigError(f"{where}: there is no parameter `{name[:40]}`")
        spec = self.specs[index]
        if spec.is_read_only:
            raise ConfigError(f"{where}: {name} is read-only")
        try:
            value = float(number)
        except ValueError:
            raise ConfigError(f"{where}: {name} must be a number, not `{number[:40]}`") from None
        spec = replace(spec, minimum=None, maximum=None)
        if not (spec.kind.is_integer or math.isfinite(value)):
            return index, _stored(spec, value)
        return index, _checked(spec, value, f"{where}: {name}")


def _checked(spec: ParamSpec, value: float, where: str) -> float:
    """Return the value as stored; raise `ConfigError` if it is not allowed."""
    problem = spec.problem_with(value)
    if problem is not None:
        raise ConfigError(f"{where}: {value:g} is {problem}")
    return _stored(spec, value)


def _stored(spec: ParamSpec, value: float) -> float:
    return int(value) if spec.kind.is_integer else nearest_real32(value)


def _shortest(value: float) -> str:
    """Return the fewest digits that are read back as the same single-precision number."""
    if isinstance(value, int):
        return str(value)
    if not math.isfinite(value):
        return str(value)
    texts = (f"{value:.{digits}g}" for digits in range(6, 10))
    return next(text for text in texts if nearest_real32(float(text)) == value)


NO_INDEX = 0xFFFF
HASH_CHECK = "_HASH_CHECK"
MAX_LISTS = 16
"""Maximum number of lists at a time; a client that is not served requests again, as clients do when
a list does not come."""
MAX_BURST = 64
"""Largest number of values per call; a slow caller catches up gradually."""


@dataclass(frozen=True, slots=True)
class ParameterProfile:
    """Behaviour of an autopilot in the parameter protocol."""

    encoding: ParamEncoding
    checks_type: bool
    """True if a PARAM_SET of another type is ignored; otherwise the parameter's own type counts."""
    reports_index_of_named: bool
    """True if a value read or set by name has its index; otherwise 65535."""
    has_hash_check: bool
    stores_nan: bool
    """True if NaN is stored; otherwise it is ignored silently."""
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
                Outgoing(self._listed(index), channel) for index in range(listing.sent, end)
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

    def _listed(self, index: int) -> Message:
        if not self._rules.has_hash_check:
            return self._value(index)
        return self._hash_check() if index == 0 else self._value(index - 1)

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
            if not rules.reports_read_only:
                return []
            kept = Outgoing(self._value(index, is_named=True))
            return [kept, *self._texts.warn(partner, f"{spec.name} kept: is read-only")]
        value = value_from_raw(raw_of(message), spec.kind, rules.encoding)
        if not (math.isfinite(value) or rules.stores_nan):
            return []
        if spec.kind.is_integer:  # as C casts a float to an integer type
            least, greatest = (int(bound) for bound in spec.kind.bounds)
            value = least + (int(value) - least) % (greatest - least + 1)
        self.store.set(name, value)
        return [Outgoing(self._value(index, is_named=True))] * rules.echoes
