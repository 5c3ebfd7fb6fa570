"""The flight report as a page; complete in itself: no network, no scripts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from companion import __version__
from companion.flight_facts import FlightFacts, open_flight
from companion.io.event_lines import event_lines
from companion.io.files import write_text_atomic
from companion.io.flight_files import EVENTS, REPORT
from companion.report.charts import charts, fence_of, flight_map
from companion.report.story import Line, Story, story_of

MAX_TOLD = 500
"""Lines of the table of events; the event log has all."""
QUICK_BYTES = 3_000_000
"""An event log up to this, a quarter of an hour, is a report in well under a second."""

LINK_WORDS = {
    "loss": "share of frames lost",
    "received": "frames received",
    "lost": "frames lost",
    "late": "frames late",
    "duplicates": "frames received twice",
    "overtaken": "frames overtaken by newer ones",
    "tick_s": "control tick, s",
    "missed_ticks": "control ticks missed",
    "stalls": "times that the computer stood still",
    "undecodable": "frames that could not be read",
    "strangers": "frames of strangers",
    "moves": "times that the autopilot's address changed",
    "echoes": "own frames that came back",
    "setpoints": "setpoints sent",
    "setpoint_rate_hz": "setpoints a second, at the end",
    "accepted": "measurements accepted",
    "refused": "measurements refused",
    "restarts": "restarts of the autopilot",
}
"""What the counters of the event log mean; one that is new has its own name."""


def report_page(story: Story, facts: FlightFacts, name: str) -> str:
    """The page as text.

    Args:
        story: The flight.
        facts: How it was flown.
        name: Of the flight.
    """
    environment = Environment(
        loader=PackageLoader("companion.report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    fence, keep_outs = fence_of(story, facts.config)
    return environment.get_template("flight.html.j2").render(
        name=name,
        story=story,
        facts=facts,
        verdict=verdict_of(story),
        link=story.links[-1] if story.links else None,
        link_rows=_link_rows(story.links[-1]) if story.links else [],
        has_fence=bool(fence),
        has_keep_outs=bool(keep_outs),
        map=Markup(flight_map(story, facts.config)),
        charts=[
            (chart.title, chart.note, Markup(chart.svg)) for chart in charts(story, facts.config)
        ],
        told=story.told[:MAX_TOLD],
        guard=story.guard.most_common(),
        version=__version__,
    )


def verdict_of(story: Story) -> str:
    """The flight in one phrase."""
    if story.results:
        sizes = [result.get("r95_m") for result in story.results]
        told = " and ".join(f"{r95_m:.2f} m" for r95_m in sizes if isinstance(r95_m, float))
        return f"localised, R95 {told}" if told else "localised"
    if story.last is None:
        return "nothing was heard of the emitter"
    return f"not reported: {story.last.state}, R95 {story.last.r95_m:.1f} m"


def write_report(flight: Path, output: Path | None = None) -> Path:
    """Write the report of a recorded flight; where it is.

    Args:
        flight: The flight's folder, or a file in it.
        output: Where to; None: `report.html` in the folder.

    Raises:
        ConfigError: The flight cannot be read.
        CompanionError: The report cannot be written.
    """
    found = open_flight(flight)
    lines = [*_older(found.directory), *event_lines(found.path(EVENTS))]
    page = report_page(story_of(lines), found.facts, found.directory.resolve().name)
    path = found.path(REPORT) if output is None else output
    write_text_atomic(path, page)
    return path


def is_quick(flight: Path) -> bool:
    """Whether the report of a flight is made in about a second."""
    try:
        return (flight / EVENTS).stat().st_size <= QUICK_BYTES
    except OSError:
        return False


def _older(directory: Path) -> list[Line]:
    """What was put aside when the log reached half its cap."""
    path = directory / "events.old.jsonl"
    if not path.exists():
        return []
    lines: list[Line] = list(event_lines(path))
    return lines


def _link_rows(link: Line) -> list[tuple[str, str]]:
    rows = []
    for name, value in link.items():
        if name in ("t_s", "kind", "links"):
            continue
        rows.append((LINK_WORDS.get(name, name.replace("_", " ")), _shown(value)))
    return rows


def _shown(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name}: {_shown(count)}" for name, count in value.items()) or "none"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
