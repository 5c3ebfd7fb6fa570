"""What views need of the past: texts, marks of the last ranges, and the curves.

It listens where the flight log does, so nothing is measured twice; every list is bounded.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

from companion.guidance.commands import Severity

TEXTS = 50
MARKS = 12
"""Rings and bearings that a map shows at once; more of them hide the estimate."""
CURVE_POINTS = 600
CURVE_STEP_S = 0.5
"""Curves keep five minutes at this step; a longer flight keeps every second point, and so on."""
MARK_FIELDS = ("sensor_enu_m", "range_m", "bearing_enu_rad", "range_weight", "emitter_id")
CURVE_FIELDS = ("range_innovation", "range_offset_m", "r95_m", "nis")

Json = dict[str, object]


class Collector:
    """Gathers texts, marks and curve points until a view takes them."""

    def __init__(self) -> None:
        self.texts: deque[tuple[float, str, str]] = deque(maxlen=TEXTS)
        """(time_s, severity, text)"""
        self.marks: deque[Json] = deque(maxlen=MARKS)
        self._curve: deque[Json] = deque(maxlen=CURVE_POINTS)
        self._next_point_s = 0.0

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Take in what the flight log is told; only estimates matter here."""
        if kind != "estimate":
            return
        if fields.get("sensor_enu_m") is not None:
            self.marks.append({"t_s": now_s, **{name: fields.get(name) for name in MARK_FIELDS}})
        if now_s >= self._next_point_s:
            self._next_point_s = now_s + CURVE_STEP_S
            self._curve.append({"t_s": now_s, **{name: fields.get(name) for name in CURVE_FIELDS}})

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        """Take in a text for the operator."""
        self.texts.append((now_s, severity.name.lower(), text))

    def take_curve(self) -> list[Json]:
        """The curve points since they were last taken."""
        points = list(self._curve)
        self._curve.clear()
        return points
