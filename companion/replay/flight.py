"""A recorded flight through the same endpoint once more.

What the endpoint was told is in `flight.inputs`, so the replay takes the very same way: frames,
ticks and stops at their own times, and nothing else. With the configuration of the flight it gives
the same estimates and the same setpoints, byte for byte; `companion.replay.comparison` looks
whether that is so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from companion.config.schema import CompanionConfig
from companion.flight_facts import FlightFacts
from companion.guidance.commands import ReportResult, Severity
from companion.guidance.events import Wish
from companion.io.files import plain
from companion.io.inputs import Input, InputKind, recalled
from companion.link.endpoint import CompanionEndpoint
from companion.link.journal import Journal
from companion.mav.dialect import mavlink
from companion.mav.endpoint import Chunk
from companion.mav.framing import message_id
from companion.run import build_endpoint, build_planner
from companion.tuning import Tunables

Json = dict[str, object]
OnInput = Callable[[CompanionEndpoint, float], None]
"""Called after every input: the endpoint, and the flight's time."""

Listen = Callable[[Journal], Journal]

SETPOINT_IDS = frozenset(
    {
        mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED,
        mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_GLOBAL_INT,
    }
)


@dataclass(slots=True)
class Course:
    """What a flight came to, recorded or replayed."""

    estimates: list[Json] = field(default_factory=list)
    """Lines of the event log."""
    setpoints: list[bytes] = field(default_factory=list)
    """Frames, in order."""
    localised_s: float | None = None
    """When a target was reported first."""


class CourseJournal:
    """The endpoint's journal during a replay."""

    def __init__(self) -> None:
        self.course = Course()
        self.texts: list[tuple[float, Severity, str]] = []

    def frame(self, data: bytes, now_s: float) -> None:
        """Frames are collected where they are sent."""

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Keep an estimate in the words of the event log."""
        if kind == "estimate":
            line = plain({"t_s": round(now_s, 4), "kind": kind, **fields})
            assert isinstance(line, dict)
            self.course.estimates.append(line)

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        """Keep a text."""
        self.texts.append((now_s, severity, text))

    def result(self, report: ReportResult, now_s: float) -> None:
        """Keep when a target was reported first."""
        del report
        if self.course.localised_s is None:
            self.course.localised_s = now_s


def rerun(
    inputs: Iterable[Input],
    config: CompanionConfig,
    facts: FlightFacts,
    on_input: OnInput | None = None,
    listen: Listen | None = None,
) -> Course:
    """Run a flight again.

    Args:
        inputs: What the endpoint was told.
        config: The flight's, or another one to compare with.
        facts: How it was flown.
        on_input: Sees the endpoint after every input.
        listen: Makes a journal that hears everything, too, and passes it on.
    """
    journal = CourseJournal()
    tunables = Tunables(config, build_planner)
    if config == facts.config:
        tunables.restore(facts.parameters)
    ranging_links = facts.links - 1 - facts.gcs_links
    endpoint = build_endpoint(
        config,
        journal if listen is None else listen(journal),
        ranging_links,
        tunables=tunables,
        gcs_links=facts.gcs_links,
    )
    for value in inputs:
        match value.kind:
            case InputKind.FRAME:
                chunk = Chunk(value.link, value.data, value.peer)
                endpoint.receive(chunk, value.time_s)
            case InputKind.TICK:
                endpoint.handle_timer(value.time_s)
            case InputKind.STOP:
                endpoint.request_stop(value.time_s)
            case InputKind.WISH:
                endpoint.ask(Wish(value.data.decode()), value.time_s)
            case InputKind.EARLIER_RUN:
                endpoint.found_earlier_run(value.time_s)
            case InputKind.RECALL:
                endpoint.recall(*recalled(value), value.time_s)
        sent = [chunk.data for chunk in endpoint.take_output()]
        journal.course.setpoints += [data for data in sent if message_id(data) in SETPOINT_IDS]
        if on_input is not None:
            on_input(endpoint, value.time_s)
    return journal.course
