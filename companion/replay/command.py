"""`companion replay` of a flight: runs it again and says whether it is the same."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from companion.config.schema import CompanionConfig
from companion.io.flight_files import INPUTS
from companion.kernel import IS_COMPILED
from companion.link.endpoint import CompanionEndpoint
from companion.replay.comparison import Comparison
from companion.replay.flight import Listen, OnInput, rerun
from companion.replay.recorded import open_recording

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class FlightReplay:
    """A flight's replay, and how exact it can be."""

    comparison: Comparison
    is_exact: bool
    """Whether the inputs were recorded; otherwise ticks were guessed from the tlog."""
    is_same_configuration: bool

    @property
    def verdict(self) -> str:
        """One line: the same, or not, and why that may be."""
        comparison = self.comparison
        counts = (
            f"{len(comparison.recorded.estimates)} estimates and "
            f"{len(comparison.recorded.setpoints)} setpoints"
        )
        if comparison.is_identical:
            return f"IDENTICAL: {counts}, bit for bit"
        first = comparison.first_difference
        if not self.is_same_configuration:
            return f"another configuration, first different: {first}"
        if not self.is_exact:
            return f"close, not exact (no {INPUTS}, so ticks are guessed), first different: {first}"
        return f"DIFFERENT with the flight's own configuration: {first}"

    @property
    def is_failed(self) -> bool:
        """Whether it should have been identical, and is not."""
        is_expected = self.is_exact and self.is_same_configuration
        return is_expected and not self.comparison.is_identical


def replay_flight(
    path: Path,
    config: CompanionConfig | None,
    say: Say,
    on_input: OnInput | None = None,
    listen: Listen | None = None,
) -> FlightReplay:
    """Run a recorded flight again.

    Args:
        path: Its folder, a file in it, or an MCAP file.
        config: Another configuration; None: the flight's own.
        say: Takes remarks for people.
        on_input: Sees the endpoint after every input.
        listen: Makes a journal that hears everything, too, and passes it on.

    Raises:
        ConfigError: The flight cannot be read.
    """
    recording = open_recording(path)
    facts = recording.facts
    used = facts.config if config is None else config
    if facts.is_compiled != IS_COMPILED:
        how = "compiled" if facts.is_compiled else "plain"
        say(f"the flight used {how} kernels, this replay does not: last digits may differ")
    course = rerun(recording.inputs, used, facts, on_input, listen)
    return FlightReplay(
        comparison=Comparison(recording.course, course),
        is_exact=recording.is_exact,
        is_same_configuration=used == facts.config,
    )


class Pace:
    """Lets a replay take its time, for people who watch.

    Args:
        speed: Times real time.
    """

    def __init__(self, speed: float) -> None:
        self._speed = speed
        self._started: tuple[float, float] | None = None

    def __call__(self, endpoint: CompanionEndpoint, now_s: float) -> None:
        """Wait until it is time for this input."""
        del endpoint
        if self._started is None:
            self._started = (time.monotonic(), now_s)
        wall_s, first_s = self._started
        ahead_s = wall_s + (now_s - first_s) / self._speed - time.monotonic()
        if ahead_s > 0.0:
            time.sleep(ahead_s)
