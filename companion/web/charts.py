"""Curves over time: residual, offset, R95 and NIS."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from nicegui import ui

CURVES = (
    ("r95_m", "R95, m", "log"),
    ("range_innovation", "range residual, m", "value"),
    ("range_offset_m", "range offset, m", "value"),
    ("nis", "NIS", "value"),
)
LEAST_SHOWN = 0.01
"""A logarithmic axis has no zero."""
REDRAW_EVERY = 4
"""Curves change slowly: drawn anew with every fourth picture."""


class Charts:
    """Four small charts, side by side on a desk and one below the other on a phone."""

    def __init__(self) -> None:
        self._count = 0
        with ui.row().classes("w-full gap-2"):
            self._charts = {
                name: ui.echart(_options(title, axis)).classes("h-40 flex-1 min-w-[300px]")
                for name, title, axis in CURVES
            }

    def show(self, curve: Sequence[Mapping[str, Any]]) -> None:
        """Draw the curves, now and then."""
        self._count += 1
        if self._count % REDRAW_EVERY != 1:
            return
        for name, _, axis in CURVES:
            points = [[point["t_s"], point[name]] for point in curve if point[name] is not None]
            if axis == "log":
                points = [[time_s, max(value, LEAST_SHOWN)] for time_s, value in points]
            chart = self._charts[name]
            chart.options["series"][0]["data"] = points
            chart.update()


def _options(title: str, axis: str) -> dict[str, Any]:
    return {
        "title": {"text": title, "textStyle": {"fontSize": 12}, "top": 0},
        "grid": {"left": 45, "right": 10, "top": 24, "bottom": 22},
        "animation": False,
        "xAxis": {"type": "value", "min": "dataMin", "max": "dataMax"},
        "yAxis": {"type": axis, "scale": True, "axisLabel": {"fontSize": 10}},
        "series": [{"type": "line", "showSymbol": False, "data": []}],
    }
