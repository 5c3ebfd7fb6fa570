"""A recorded flight as its logs tell it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from companion.errors import ConfigError
from companion.flight_facts import FlightFacts, facts_of_json, open_flight
from companion.io.event_lines import event_lines
from companion.io.flight_files import EVENTS, INPUTS, TLOG
from companion.io.inputs import Input, InputKind, parse_inputs, read_inputs
from companion.io.mcap_reader import McapFlight, read_mcap_flight
from companion.io.tlog import TlogRecord, read_tlog
from companion.mav.framing import message_id, sender_of
from companion.replay.flight import SETPOINT_IDS, Course, Json

OWN_COMPONENT = 191
TICK_S = 0.05


@dataclass(frozen=True, slots=True)
class Recording:
    """A recorded flight, ready to be run again."""

    facts: FlightFacts
    inputs: list[Input]
    is_exact: bool
    """Whether the inputs were recorded; otherwise they were guessed from the frames."""
    course: Course


def open_recording(path: Path) -> Recording:
    """A recorded flight: its folder, any file in it, or an MCAP file alone.

    Raises:
        ConfigError: It cannot be read.
    """
    if path.suffix.lower() == ".mcap":
        return _of_mcap(read_mcap_flight(path))
    flight = open_flight(path)
    lines = event_lines(flight.path(EVENTS))
    records = list(read_tlog(flight.path(TLOG)))
    course = course_of(lines, [record.frame for record in records])
    inputs_path = flight.path(INPUTS)
    if inputs_path.exists():
        return Recording(flight.facts, list(read_inputs(inputs_path)), True, course)
    inputs = inputs_of_tlog(records)
    if not inputs:
        raise ConfigError(f"{flight.path(TLOG)}: has no frames")
    return Recording(flight.facts, inputs, False, course)


def _of_mcap(found: McapFlight) -> Recording:
    try:
        facts = facts_of_json(found.flight_json)
    except ConfigError as error:
        raise ConfigError(f"{found.path}: {error}") from error
    inputs = list(parse_inputs(found.inputs, str(found.path)))
    return Recording(facts, inputs, True, course_of(found.events, found.frames))


def course_of(lines: Iterable[Json], frames: Iterable[bytes]) -> Course:
    """The estimates and setpoints in a flight's logs.

    Args:
        lines: Of the event log.
        frames: Sent and received.
    """
    course = Course()
    for line in lines:
        if line.get("kind") == "estimate":
            course.estimates.append(line)
        elif line.get("kind") == "result" and course.localised_s is None:
            time_s = line.get("time_s")
            course.localised_s = float(time_s) if isinstance(time_s, int | float) else None
    for frame in frames:
        if sender_of(frame)[1] == OWN_COMPONENT and message_id(frame) in SETPOINT_IDS:
            course.setpoints.append(frame)
    return course


def inputs_of_tlog(records: list[TlogRecord]) -> list[Input]:
    """Inputs for a log that has none: its frames, and ticks at 20 Hz between them.

    The flight's own ticks came at other instants, so a replay of these is close, not the same.
    """
    if not records:
        return []
    start_us = records[0].unix_us
    inputs: list[Input] = []
    next_tick_s = 0.0
    for record in records:
        time_s = 1e-6 * max(0, record.unix_us - start_us)
        while next_tick_s <= time_s:
            inputs.append(Input(InputKind.TICK, next_tick_s))
            next_tick_s += TICK_S
        if sender_of(record.frame)[1] != OWN_COMPONENT:
            inputs.append(Input(InputKind.FRAME, time_s, data=record.frame))
    return inputs
