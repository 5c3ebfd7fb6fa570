"""`flight.json`: how a flight was flown, for its replay and its report."""

from __future__ import annotations

import platform
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from companion import __version__
from companion.config.schema import CompanionConfig
from companion.errors import ConfigError
from companion.io.files import write_bytes_atomic
from companion.io.flight_files import FLIGHT
from companion.kernel import IS_COMPILED


class FlightFacts(msgspec.Struct, frozen=True, kw_only=True):
    """What a replay and a report must know of a flight."""

    started_unix_s: float
    links: int
    """The vehicle's, those that carry only ranging, and ground stations'."""
    gcs_links: int = 0
    """How many of them lead to ground stations."""
    config: CompanionConfig
    """As its file had it."""
    parameters: dict[str, float] = {}
    """What a ground station had changed before the flight, by name."""
    version: str = __version__
    python: str = platform.python_version()
    numpy: str = np.__version__
    is_compiled: bool = IS_COMPILED
    """Compiled kernels may differ from plain ones in the last digits."""


@dataclass(frozen=True, slots=True)
class Flight:
    """A recorded flight on disk."""

    directory: Path
    facts: FlightFacts

    def path(self, name: str) -> Path:
        """One of its files."""
        return self.directory / name


def write_facts(directory: Path, facts: FlightFacts) -> None:
    """Write `flight.json` into a new flight's directory.

    Raises:
        CompanionError: It cannot be written.
    """
    write_bytes_atomic(directory / FLIGHT, facts_as_json(facts))


def facts_as_json(facts: FlightFacts) -> bytes:
    """The content of `flight.json`."""
    return msgspec.json.format(msgspec.json.encode(facts), indent=2) + b"\n"


def open_flight(path: Path) -> Flight:
    """A recorded flight, by its directory or by any file in it.

    Raises:
        ConfigError: There is none; one line says what is missing.
    """
    directory = path if path.is_dir() else path.parent
    if not path.exists():
        raise ConfigError(f"{path}: there is no such file or folder")
    facts_path = directory / FLIGHT
    try:
        data = facts_path.read_bytes()
    except OSError as error:
        raise ConfigError(
            f"{facts_path}: cannot be read ({error.strerror}); give a flight's folder, as in "
            "flights/2026-11-21T02-50-00Z"
        ) from error
    try:
        return Flight(directory, facts_of_json(data))
    except ConfigError as error:
        raise ConfigError(f"{facts_path}: {error}") from error


def facts_of_json(data: bytes) -> FlightFacts:
    """What `facts_as_json` wrote.

    Raises:
        ConfigError: It is something else, or of a version that cannot be read.
    """
    try:
        return msgspec.json.decode(data, type=FlightFacts)
    except (msgspec.DecodeError, ValueError) as error:
        raise ConfigError(f"not the facts of a flight: {error}") from error
