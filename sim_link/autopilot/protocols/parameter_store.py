"""Typed parameters: what there is, what it may be, what it is.

The set is fixed when a store is made, as the guide wants: names and indices never change at run
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
from companion.mav.param_encoding import (
    NAME_LENGTH,
    ParamEncoding,
    ParamType,
    nearest_real32,
    raw_value,
)

COMMENT = "#"


@dataclass(frozen=True, slots=True)
class ParamSpec:
    """One parameter."""

    name: str
    kind: ParamType
    default: float
    minimum: float | None = None
    """None for the least value of its type."""
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
        """The least and the greatest value allowed."""
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
    """Return the value as it is stored; `ConfigError`: it may not be."""
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
