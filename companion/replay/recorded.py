"""What a flight directory says the flight came to."""

from __future__ import annotations

import json
from pathlib import Path

from companion.errors import ConfigError
from companion.flight_facts import Flight
from companion.io.flight_files import EVENTS, TLOG
from companion.io.inputs import Input, InputKind
from companion.io.tlog import TlogRecord, read_tlog
from companion.mav.framing import message_id, sender_of
from companion.replay.flight import SETPOINT_IDS, Course

OWN_COMPONENT = 191
TICK_S = 0.05


def recorded_course(flight: Flight) -> Course:
    """The estimates and setpoints that the flight left.

    Raises:
        ConfigError: A file cannot be read.
    """
    course = Course()
    for line in event_lines(flight.path(EVENTS)):
        if line.get("kind") == "estimate":
            course.estimates.append(line)
        elif line.get("kind") == "result" and course.localised_s is None:
            time_s = line.get("time_s")
            course.localised_s = float(time_s) if isinstance(time_s, int | float) else None
    for record in read_tlog(flight.path(TLOG)):
        _, component = sender_of(record.frame)
        if component == OWN_COMPONENT and message_id(record.frame) in SETPOINT_IDS:
            course.setpoints.append(record.frame)
    return course


def event_lines(path: Path) -> list[dict[str, object]]:
    """The event log; a torn last line (a power cut) is left out.

    Raises:
        ConfigError: It cannot be read, or a line in its midst is no JSON.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from error
    values: list[dict[str, object]] = []
    for number, line in enumerate(lines, start=1):
        try:
            values.append(json.loads(line))
        except json.JSONDecodeError as error:
            if number == len(lines):
                break
            raise ConfigError(f"{path}: line {number}: {error}") from error
    return values


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
