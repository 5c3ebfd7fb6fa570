"""Recorded flight, read from its logs, and its rerun through the same endpoint.

The endpoint's inputs are in `flight.inputs`, so the replay has the same frames, ticks and stops at
the same times, and nothing else. With the configuration of the flight the estimates and the
setpoints are the same, byte for byte; `flight_replay` checks that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from companion.config.radios import replayed_radios
from companion.config.schema import CompanionConfig
from companion.config.tunables import Tunables
from companion.errors import ConfigError
from companion.flight_setup import (
    FlightFacts,
    RecordedFlight,
    build_endpoint,
    build_planner,
    facts_of_json,
    open_flight,
)
from companion.guidance.commands import ReportResult
from companion.io.files import EVENTS, INPUTS, TLOG, plain
from companion.io.log_files import (
    Input,
    InputKind,
    TlogRecord,
    damage_text,
    event_lines,
    event_of,
    parse_inputs,
    read_inputs,
    read_tlog,
)
from companion.io.mcap_file import read_mcap_flight
from companion.link.endpoint import CompanionEndpoint
from companion.mav.codec import message_id, sender_of
from companion.mav.dialect import SETPOINT_IDS
from companion.mav.endpoint import Chunk
from companion.run import FlightView, ViewedJournal

Json = dict[str, object]
OnInput = Callable[[CompanionEndpoint, float], None]
"""Called after every input: the endpoint, and the flight's time."""


@dataclass(slots=True)
class Outputs:
    """Estimates and setpoints of a flight, recorded or replayed."""

    estimates: list[Json] = field(default_factory=list)
    setpoints: list[bytes] = field(default_factory=list)
    localised_s: float | None = None
    whole: tuple[int, int] | None = None
    """Number of estimates and setpoints before the first damaged input; None if none is damaged."""

    @property
    def size(self) -> tuple[int, int]:
        """Number of estimates and setpoints."""
        return len(self.estimates), len(self.setpoints)

    def first(self, estimates: int, setpoints: int) -> Outputs:
        """Return its beginning, with these numbers of estimates and setpoints."""
        return Outputs(self.estimates[:estimates], self.setpoints[:setpoints], self.localised_s)


class OutputJournal(FlightView):
    """The endpoint's journal during a replay."""

    def __init__(self) -> None:
        self.output = Outputs()

    def frame(self, data: bytes, now_s: float) -> None:
        """Do nothing: frames are collected where they are sent."""

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Keep an estimate in the form of the event log."""
        if kind == "estimate":
            line = plain({"t_s": round(now_s, 4), "kind": kind, **fields})
            assert isinstance(line, dict)
            self.output.estimates.append(line)

    def result(self, report: ReportResult, now_s: float) -> None:
        """Keep the time of the first report."""
        del report
        if self.output.localised_s is None:
            self.output.localised_s = now_s


def rerun(
    inputs: Iterable[Input],
    config: CompanionConfig,
    facts: FlightFacts,
    on_input: OnInput | None = None,
    views: Sequence[FlightView] = (),
    whole: int | None = None,
) -> Outputs:
    """Run a flight again; `on_input` follows every input, views get the reports.

    `Outputs.whole` counts the results of the first `whole` inputs; None: of all.
    """
    journal = OutputJournal()
    tunables = Tunables(config, build_planner)
    if config == facts.config:
        tunables.restore(facts.parameters)
    heard = ViewedJournal(journal, views)
    specs = facts.link_specs(replayed_radios(facts.config.radios, config.radios))
    endpoint = build_endpoint(config, heard, specs, tunables=tunables)
    for number, value in enumerate(inputs):
        if number == whole:
            journal.output.whole = journal.output.size
        match value.kind:
            case InputKind.FRAME:
                chunk = Chunk(value.link, value.data, value.peer)
                endpoint.receive(chunk, value.time_s)
            case InputKind.TICK:
                endpoint.handle_timer(value.time_s)
            case _:
                endpoint.handle_event(event_of(value))
        sent = [chunk.data for chunk in endpoint.take_output()]
        journal.output.setpoints += [data for data in sent if message_id(data) in SETPOINT_IDS]
        if on_input is not None:
            on_input(endpoint, value.time_s)
    if whole is not None and journal.output.whole is None:
        journal.output.whole = journal.output.size
    return journal.output


OWN_COMPONENT = 191
TICK_S = 0.05
LONGEST_PAUSE_S = 60.0
"""Longest pause between frames of a tlog; a longer one is a change of the wall clock."""


@dataclass(frozen=True, slots=True)
class FlightRecording:
    """A recorded flight, ready to be run again."""

    facts: FlightFacts
    inputs: list[Input]
    is_exact: bool
    """True if the inputs were recorded; otherwise they are guessed from the frames."""
    output: Outputs
    whole_inputs: int | None = None
    """Number of inputs before the first that is damaged or missing; None if none is."""
    is_course_whole: bool = True
    damage: tuple[str, ...] = ()
    """Description of the unreadable parts, a line for each file."""


def is_mcap(path: Path) -> bool:
    """Return True for an MCAP file, which holds a flight by itself."""
    return path.suffix.lower() == ".mcap"


def open_recording(path: Path) -> FlightRecording:
    """Return a recorded flight: its folder, any file in it, or an MCAP file; or `ConfigError`."""
    if is_mcap(path):
        found = read_mcap_flight(path)
        try:
            facts = facts_of_json(found.flight_json)
        except ConfigError as error:
            raise ConfigError(f"{found.path}: {error}") from error
        parsed = list(parse_inputs(found.inputs, str(found.path)))
        return FlightRecording(facts, parsed, True, outputs_of(found.events, found.frames))
    flight = open_flight(path)
    bad_lines: list[int] = []
    bad_frames: list[int] = []
    lines = event_lines(flight.path(EVENTS), bad_lines.append)
    records = list(read_tlog(flight.path(TLOG), bad_frames.append))
    output = outputs_of(lines, [record.frame for record in records])
    inputs, whole, bad_inputs = _inputs_of(flight, records)
    early = ""
    if whole is None and _lacks_last(records, inputs):
        whole = len(inputs)
        early = f"{flight.path(INPUTS)}: ends before {TLOG} does; compared up to there"
    damage = (
        damage_text(flight.path(EVENTS), "line", bad_lines),
        damage_text(flight.path(TLOG), "byte", bad_frames),
        damage_text(flight.path(INPUTS), "record", bad_inputs) or early,
    )
    return FlightRecording(
        flight.facts,
        inputs,
        flight.path(INPUTS).exists(),
        output,
        whole,
        not bad_lines and not bad_frames and not _ends_early(records, inputs, flight.facts),
        tuple(text for text in damage if text),
    )


def _lacks_last(records: list[TlogRecord], inputs: list[Input]) -> bool:
    """Return True if the last frame that a flight received is not among its inputs."""
    received = (r.frame for r in reversed(records) if sender_of(r.frame)[1] != OWN_COMPONENT)
    last = next(received, None)
    return last is not None and all(value.data != last for value in reversed(inputs))


FLUSHED_WITHIN_S = 0.1
"""Longest time between the ends of two whole logs: two control ticks."""


def _ends_early(records: list[TlogRecord], inputs: list[Input], facts: FlightFacts) -> bool:
    """Return True if the tlog was cut between two frames, by its time and that of the inputs."""
    if not records or not inputs:
        return False
    last_s = 1e-6 * records[-1].unix_us - facts.started_unix_s
    return last_s < inputs[-1].time_s - FLUSHED_WITHIN_S


def _inputs_of(
    flight: RecordedFlight, records: list[TlogRecord]
) -> tuple[list[Input], int | None, list[int]]:
    """Return the inputs, the number of whole ones, and the numbers of damaged records."""
    path = flight.path(INPUTS)
    inputs: list[Input] = []
    bad: list[int] = []
    if not path.exists():
        inputs = inputs_of_tlog(records)
        if not inputs:
            raise ConfigError(f"{flight.path(TLOG)}: has no frames")
        return inputs, None, []
    whole: list[int] = []

    def on_damage(number: int) -> None:
        bad.append(number)
        whole.append(len(inputs))

    for value in read_inputs(path, on_damage):
        try:
            if value.kind not in (InputKind.FRAME, InputKind.TICK):
                event_of(value)
            if value.link >= flight.facts.links:
                raise ConfigError(f"link {value.link} of {flight.facts.links}")
            inputs.append(value)
        except ConfigError:
            on_damage(len(inputs) + 1)
    return inputs, min(whole, default=None), bad


def outputs_of(lines: Iterable[Json], frames: Iterable[bytes]) -> Outputs:
    """Return the estimates and setpoints in a flight's logs."""
    output = Outputs()
    for line in lines:
        if line.get("kind") == "estimate":
            output.estimates.append(line)
        elif line.get("kind") == "result" and output.localised_s is None:
            time_s = line.get("time_s")
            output.localised_s = float(time_s) if isinstance(time_s, int | float) else None
    for frame in frames:
        if sender_of(frame)[1] == OWN_COMPONENT and message_id(frame) in SETPOINT_IDS:
            output.setpoints.append(frame)
    return output


def inputs_of_tlog(records: list[TlogRecord]) -> list[Input]:
    """Return inputs for a log without them: frames, and ticks at 20 Hz instead of the flight's."""
    if not records:
        return []
    last_us = records[0].unix_us
    inputs: list[Input] = []
    time_s = next_tick_s = 0.0
    for record in records:
        step_s = 1e-6 * (record.unix_us - last_us)
        time_s += step_s if 0.0 <= step_s <= LONGEST_PAUSE_S else 0.0
        last_us = record.unix_us
        while next_tick_s <= time_s:
            inputs.append(Input(InputKind.TICK, next_tick_s))
            next_tick_s += TICK_S
        if sender_of(record.frame)[1] != OWN_COMPONENT:
            inputs.append(Input(InputKind.FRAME, time_s, data=record.frame))
    return inputs
