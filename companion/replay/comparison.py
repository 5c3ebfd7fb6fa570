"""Recorded and replayed side by side: the same to the last bit, or how far apart."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest

from companion.replay.flight import Course, Json


@dataclass(frozen=True, slots=True)
class Comparison:
    """What a replay says about a recording."""

    recorded: Course
    replayed: Course

    @property
    def is_identical(self) -> bool:
        """Whether every estimate and every setpoint is the same, bit for bit."""
        return self.first_difference is None

    @property
    def first_difference(self) -> str | None:
        """Where the two part, in words; None if they do not."""
        pairs = zip_longest(self.recorded.estimates, self.replayed.estimates)
        for number, (before, after) in enumerate(pairs, start=1):
            if before != after:
                return f"estimate {number}{_parting(before, after)}"
        frames = zip_longest(self.recorded.setpoints, self.replayed.setpoints)
        for number, (sent, again) in enumerate(frames, start=1):
            if sent != again:
                return f"setpoint {number}"
        return None

    def table(self) -> str:
        """Both courses in lines of text."""
        rows = [("", "recorded", "replayed")]
        for name, read in _ROWS:
            rows.append((name, read(self.recorded), read(self.replayed)))
        apart = apart_m(self.recorded.estimates, self.replayed.estimates)
        lines = [f"{name:<22} {before:>14} {after:>14}" for name, before, after in rows]
        if apart is not None:
            lines.append(f"estimates apart: {apart[0]:.3f} m at most, {apart[1]:.3f} m at the end")
        return "\n".join(lines)

    def as_json(self) -> Json:
        """Plain values for `--json`."""
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
    """The largest and the last distance of estimates at the same times; None without any."""
    replayed_at = _by_time(replayed)
    apart = [
        math.dist(here, replayed_at[key])
        for key, here in _by_time(recorded).items()
        if key in replayed_at
    ]
    return (max(apart), apart[-1]) if apart else None


def _by_time(lines: Sequence[Json]) -> dict[tuple[object, int], tuple[float, float]]:
    """Places by time; the number tells several estimates of one time apart."""
    places: dict[tuple[object, int], tuple[float, float]] = {}
    seen: Counter[object] = Counter()
    for line in lines:
        time_s, place = line.get("t_s"), place_of(line)
        seen[time_s] += 1
        if place is not None:
            places[time_s, seen[time_s]] = place
    return places


def place_of(line: Json) -> tuple[float, float] | None:
    """East and north of an estimate's line."""
    place = line.get("position_enu_m")
    if not isinstance(place, list | tuple) or len(place) < 2:
        return None
    return (float(place[0]), float(place[1]))


def _parting(before: Json | None, after: Json | None) -> str:
    if before is None or after is None:
        return ": one of them has no more"
    names = [name for name in {**before, **after} if before.get(name) != after.get(name)]
    return f" at {before.get('t_s')} s: {', '.join(names)}"


def _last(course: Course, name: str) -> str:
    if not course.estimates:
        return "-"
    value = course.estimates[-1].get(name)
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def _place(course: Course, axis: int) -> str:
    place = place_of(course.estimates[-1]) if course.estimates else None
    return "-" if place is None else f"{place[axis]:.3f}"


def _localised(course: Course) -> str:
    return "never" if course.localised_s is None else f"{course.localised_s:.1f}"


_ROWS = (
    ("estimates", lambda course: str(len(course.estimates))),
    ("setpoints", lambda course: str(len(course.setpoints))),
    ("reported after, s", _localised),
    ("last state", lambda course: _last(course, "state")),
    ("last east, m", lambda course: _place(course, 0)),
    ("last north, m", lambda course: _place(course, 1)),
    ("last R95, m", lambda course: _last(course, "r95_m")),
    ("last range offset, m", lambda course: _last(course, "range_offset_m")),
)


def _summary(course: Course) -> Json:
    last = course.estimates[-1] if course.estimates else {}
    return {
        "estimates": len(course.estimates),
        "setpoints": len(course.setpoints),
        "localised_s": course.localised_s,
        "last": last,
    }
