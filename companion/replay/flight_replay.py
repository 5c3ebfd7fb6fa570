"""`companion replay` of a flight: runs it again and compares the result.

Recording and replay are compared: identical to the last bit, or with their distance. On the live
map a replay shows the operator's view, or the view of another configuration. It begins when a
browser has opened the map, because a fast replay would be over before; Ctrl-C ends this wait and
the display of the last moment.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import TypeVar

import msgspec

from companion.config.radios import replayed_radios
from companion.config.schema import CompanionConfig
from companion.handoff import utc_text
from companion.io.files import INPUTS
from companion.kernel import IS_COMPILED
from companion.link.endpoint import CompanionEndpoint
from companion.replay.recorded_flight import Json, OnInput, Outputs, is_mcap, open_recording, rerun
from companion.run import FlightView
from companion.web.live_map import ReplayedFlight, WebView
from companion.web.settings import WebSettings

Say = Callable[[str], None]
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class FlightReplay:
    """Comparison of a flight's replay with its recording."""

    recorded: Outputs
    replayed: Outputs
    is_exact: bool
    """True if the inputs were recorded; otherwise ticks are guessed from the tlog."""
    is_same_configuration: bool
    is_course_whole: bool = True

    @property
    def is_identical(self) -> bool:
        """True if every estimate and every setpoint is the same, bit for bit."""
        return self.first_difference is None

    @property
    def first_difference(self) -> str | None:
        """Description of the first difference between the two; None if there is none."""
        recorded, replayed = self.recorded, self.replayed
        if replayed.whole is not None:
            recorded, replayed = recorded.first(*replayed.whole), replayed.first(*replayed.whole)
        for number, before, after in self._unlike(recorded.estimates, replayed.estimates):
            return f"estimate {number}{_difference_text(before, after)}"
        for number, _, _ in self._unlike(recorded.setpoints, replayed.setpoints):
            return f"setpoint {number}"
        return None

    def _unlike(
        self, recorded: Sequence[T], replayed: Sequence[T]
    ) -> Iterator[tuple[int, T | None, T | None]]:
        """Yield number and both values of each difference; None stands for a missing one."""
        if self.is_course_whole:
            for number, (before, after) in enumerate(zip_longest(recorded, replayed), start=1):
                if before != after:
                    yield number, before, after
            return
        rest = iter(replayed)
        for number, before in enumerate(recorded, start=1):
            if self.replayed.whole is None and all(after != before for after in rest):
                yield number, before, None

    @property
    def verdict(self) -> str:
        """One line: identical, or different with a possible reason."""
        first = self.first_difference
        if first is None:
            recorded = self.recorded
            estimates, setpoints = self.replayed.whole or recorded.size
            extent = "up to the damaged inputs: " if self.replayed.whole else ""
            return (
                f"IDENTICAL: {extent}{estimates} estimates and {setpoints} setpoints, bit for bit"
            )
        if not self.is_same_configuration:
            return f"another configuration, first different: {first}"
        if not self.is_exact:
            return f"close, not exact (no {INPUTS}, so ticks are guessed), first different: {first}"
        return f"DIFFERENT with the flight's own configuration: {first}"

    @property
    def is_failed(self) -> bool:
        """True if it is not identical although it should be."""
        return self.is_exact and self.is_same_configuration and not self.is_identical

    def table(self) -> str:
        """Return both outputs as a table of text."""
        before, after = _figures(self.recorded), _figures(self.replayed)
        lines = [f"{'':<22} {'recorded':>14} {'replayed':>14}"]
        lines += [f"{name:<22} {before[name]:>14} {after[name]:>14}" for name in before]
        apart = apart_m(self.recorded.estimates, self.replayed.estimates)
        if apart is not None:
            lines.append(f"estimates apart: {apart[0]:.3f} m at most, {apart[1]:.3f} m at the end")
        return "\n".join(lines)

    def as_json(self) -> Json:
        """Return plain values for `--json`."""
        apart = apart_m(self.recorded.estimates, self.replayed.estimates)
        return {
            "identical": self.is_identical,
            "first_difference": self.first_difference,
            "recorded": _summary(self.recorded),
            "replayed": _summary(self.replayed),
            "apart_max_m": None if apart is None else apart[0],
            "apart_end_m": None if apart is None else apart[1],
        }


def apart_m(recorded: Sequence[Json], replayed: Sequence[Json]) -> tuple[float, float] | None:
    """Return the largest and the last distance of estimates at the same times; None without any."""
    replayed_at = _by_time(replayed)
    apart = [
        math.dist(here, replayed_at[key])
        for key, here in _by_time(recorded).items()
        if key in replayed_at
    ]
    return (max(apart), apart[-1]) if apart else None


def _by_time(lines: Sequence[Json]) -> dict[tuple[object, int], tuple[float, float]]:
    """Return positions by time; the number separates estimates of one time."""
    positions: dict[tuple[object, int], tuple[float, float]] = {}
    seen: Counter[object] = Counter()
    for line in lines:
        time_s, position = line.get("t_s"), position_of(line)
        seen[time_s] += 1
        if position is not None:
            positions[time_s, seen[time_s]] = position
    return positions


def position_of(line: Json) -> tuple[float, float] | None:
    """Return east and north of an estimate's line; None if it has no position."""
    position = line.get("position_enu_m")
    match position:
        case [int() | float() as east_m, int() | float() as north_m, *_]:
            return float(east_m), float(north_m)
    return None


def _difference_text(before: Json | None, after: Json | None) -> str:
    if before is None or after is None:
        return ": one of them has no more"
    names = [name for name in {**before, **after} if before.get(name) != after.get(name)]
    return f" at {before.get('t_s')} s: {', '.join(names)}"


def _figures(output: Outputs) -> dict[str, str]:
    last = output.estimates[-1] if output.estimates else {}
    east_m, north_m = position_of(last) or (None, None)
    reported = "never" if output.localised_s is None else f"{output.localised_s:.1f}"
    return {
        "estimates": str(len(output.estimates)),
        "setpoints": str(len(output.setpoints)),
        "reported after, s": reported,
        "last state": str(last.get("state", "-")),
        "last east, m": _figure(east_m),
        "last north, m": _figure(north_m),
        "last R95, m": _figure(last.get("r95_m")),
        "last absolute R95, m": _figure(last.get("absolute_r95_m")),
        "last range offset, m": _figure(last.get("range_offset_m")),
    }


def _figure(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def _summary(output: Outputs) -> Json:
    last = output.estimates[-1] if output.estimates else {}
    return {
        "estimates": len(output.estimates),
        "setpoints": len(output.setpoints),
        "localised_s": output.localised_s,
        "last": last,
    }


def replay_flight(
    path: Path,
    config: CompanionConfig | None,
    say: Say,
    on_input: OnInput | None = None,
    views: Sequence[FlightView] = (),
) -> FlightReplay:
    """Run a flight (its folder, a file in it, or MCAP) again; None: with its own configuration."""
    recording = open_recording(path)
    facts = recording.facts
    used = facts.config
    if config is not None:
        radios = replayed_radios(facts.config.radios, config.radios)
        used = msgspec.structs.replace(config, radios=radios)
    if facts.is_compiled != IS_COMPILED:
        how = "compiled" if facts.is_compiled else "plain"
        say(f"the flight used {how} kernels, this replay does not: last digits may differ")
    for text in recording.damage:
        say(text)
    output = rerun(recording.inputs, used, facts, on_input, views, recording.whole_inputs)
    return FlightReplay(
        recording.output,
        output,
        is_exact=recording.is_exact,
        is_same_configuration=used == facts.config,
        is_course_whole=recording.is_course_whole,
    )


class Pace:
    """Paces a replay for its viewers."""

    def __init__(self, speed: float) -> None:
        self._speed = speed
        self._started: tuple[float, float] | None = None

    def __call__(self, endpoint: CompanionEndpoint, now_s: float) -> None:
        """Wait until this input is due."""
        del endpoint
        if self._started is None:
            self._started = (time.monotonic(), now_s)
        wall_s, first_s = self._started
        ahead_s = wall_s + (now_s - first_s) / self._speed - time.monotonic()
        if ahead_s > 0.0:
            time.sleep(ahead_s)


REFRESH_S = 0.25
POLL_S = 0.1


class MapOfReplay:
    """Feeds the page from a replay, and keeps its last moment on the page."""

    def __init__(self, view: WebView, speed: float) -> None:
        self._view = view
        self._pace = Pace(speed)
        self._last: tuple[CompanionEndpoint, float] | None = None

    def __call__(self, endpoint: CompanionEndpoint, now_s: float) -> None:
        """Wait until this input is due, and show its result."""
        self._pace(endpoint, now_s)
        self._last = (endpoint, now_s)
        self._view.update(endpoint, now_s)

    def await_viewer(self) -> None:
        """Return once a browser has opened the page."""
        while not self._view.process.is_viewed:
            self._view.process.update(0.0, dict, may_send=False)
            time.sleep(POLL_S)

    def linger(self) -> None:
        """Show the last moment until Ctrl-C, so that the page does not call it old."""
        if self._last is None:
            return
        endpoint, ended_s = self._last
        began_s = time.monotonic()
        try:
            while True:
                # The page gets its pictures by the flight's clock, which therefore continues.
                self._view.show(endpoint, ended_s, ended_s + time.monotonic() - began_s)
                time.sleep(REFRESH_S)
        except KeyboardInterrupt:
            return


def flight_name(path: Path) -> str:
    """Return the name of a flight, given its folder, a file in that, or an MCAP file."""
    found = path.resolve()
    return found.name if found.is_dir() or is_mcap(found) else found.parent.name


def replay_on_map(
    path: Path,
    config: CompanionConfig | None,
    say: Say,
    settings: WebSettings,
    speed: float,
    done: Callable[[FlightReplay], None],
) -> FlightReplay:
    """Run a flight again on the live map, without buttons, until Ctrl-C; `done` gets the result."""
    facts = open_recording(path).facts
    used = facts.config if config is None else config
    again = "" if used == facts.config else ", with another configuration"
    began = utc_text(facts.started_unix_s).replace("T", " ").replace("Z", " UTC")
    words = f"REPLAY at {speed:g}x of flight {flight_name(path)}, begun {began}{again}"
    view = WebView(settings, used, replayed=ReplayedFlight(facts.started_unix_s, words))
    try:
        page = MapOfReplay(view, speed)
        say(f"live map: {view.url}; the replay waits for a browser there; Ctrl-C ends it")
        page.await_viewer()
        replay = replay_flight(path, config, say, page, [view])
        done(replay)
        page.linger()
    finally:
        view.close()
    return replay
