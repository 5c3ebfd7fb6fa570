"""Searched areas of flights: read from their folders, shown, combined, and put on the report."""

from __future__ import annotations

import argparse
import base64
import json
from pathlib import Path

import msgspec

from companion.area_handoff import (
    GEOJSON,
    PNG,
    RECORD,
    TEXT,
    area_files,
    geojson_of,
    result_fields,
)
from companion.errors import ConfigError
from companion.io.files import plain, read_file, write_bytes_atomic
from companion.search.outlines import gaps_of
from companion.search.searched_area import SearchState
from companion.search.searched_flight import SearchedFlight, searched_again, statement


def read_searched(flight: Path) -> SearchedFlight:
    """Return the searched area of a flight in a folder; raise `ConfigError` if there is none."""
    directory = flight if flight.is_dir() else flight.parent
    path = directory / RECORD
    if not path.exists():
        raise ConfigError(f"{directory}: has no {RECORD}; it heard something at once, or is older")
    try:
        return msgspec.json.decode(read_file(path), type=SearchedFlight)
    except (msgspec.DecodeError, ValueError) as error:
        raise ConfigError(f"{path}: not what a flight has searched: {error}") from error


def state_again(flights: list[SearchedFlight], path: Path) -> SearchState | None:
    """Return the combined state of flights; a `ConfigError` names the first one's file."""
    try:
        return searched_again(flights)
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from error


def run(arguments: argparse.Namespace) -> int:
    """Run `companion area`; return the exit code."""
    if arguments.area_command == "show":
        return _show(arguments)
    return _merge(arguments)


def _show(arguments: argparse.Namespace) -> int:
    flight = read_searched(arguments.flight)
    state = state_again([flight], arguments.flight)
    if arguments.json:
        print(json.dumps(plain(result_fields(flight, state)), indent=2))
        return 0
    print(statement(flight, state))
    if flight.learnt is not None:
        reach_m, sigma_db = flight.learnt.reach_m, flight.learnt.reach_sigma_db
        shown = f"{{reach_m: {reach_m:g}, reach_sigma_db: {sigma_db:g}}}"
        print(f"reach by the first contact, to paste: search: {{detection: {shown}}}")
    for gap in [] if state is None else gaps_of(state):
        print(f"gap: {gap.name}, {100.0 * gap.poa:.0f} % of the chance")
    return 0


def _merge(arguments: argparse.Namespace) -> int:
    """Combine flights over the area of the first one."""
    flights = [read_searched(each) for each in arguments.flights]
    state = state_again(flights, arguments.flights[0])
    first = flights[0]
    if state is None or first.origin is None:
        raise ConfigError(
            f"{arguments.flights[0]}: has no reach or no origin, so nothing can be combined with it"
        )
    reported = tuple(sorted({n for each in flights for n in each.reported}))
    together = msgspec.structs.replace(
        first,
        listened_s=sum(each.listened_s for each in flights),
        ended_unix_s=max(each.ended_unix_s for each in flights),
        is_radio_heard=all(each.is_radio_heard for each in flights),
        reported=reported,
        heard=tuple(sorted({n for each in flights for n in each.heard} - set(reported))),
    )
    try:
        arguments.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{arguments.out}: cannot be made ({error.strerror})") from error
    files = area_files(together, state)
    del files[RECORD]  # its looks are in the flights' own
    files[GEOJSON] = geojson_of(flights, state, first.origin).encode()
    for name, content in files.items():
        write_bytes_atomic(arguments.out / name, content)
    print(f"{len(flights)} flights: {statement(together, state)}")
    return 0


def report_of(directory: Path) -> tuple[str, str] | None:
    """Return the sentence and the map as a data URL, or None without a search."""
    if not (directory / TEXT).exists():
        return None
    text = read_file(directory / TEXT).decode(errors="replace").strip()
    if not (directory / PNG).exists():
        return text, ""
    encoded = base64.b64encode(read_file(directory / PNG)).decode()
    return text, f"data:image/png;base64,{encoded}"
