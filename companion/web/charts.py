"""Curves over time: residual, offset, R95 and NIS."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from nicegui import ui

from companion.geometry.ellipse import CHI2_95_TWO

CURVES = (
    ("r95_m", "R95, m", "log"),
    ("range_innovation", "Range residual, m", "value"),
    ("range_offset_m", "Range offset, m", "value"),
    ("nis", "NIS, expected: 95 % below 6", "value"),
)
LEAST_OF_GOAL = 0.1
"""Where the logarithmic axis of R95 begins, as a share of the radius that is wanted."""
REDRAW_EVERY = 4
"""Curves change slowly: drawn anew with every fourth picture."""
GREY, LINE = "#7c8a9a", "#3b82f6"
"""Read on white and on black."""


class Charts:
    """Four small charts, side by side on a desk and one below the other on a phone.

    Args:
        scene: What does not change.
    """

    def __init__(self, scene: Mapping[str, Any]) -> None:
        self._count = 0
        self._charts: dict[str, ui.echart] = {}
        goal_m = float(scene.get("stop_radius_m", 1.0))
        self._least_m = LEAST_OF_GOAL * goal_m
        with ui.row().classes("w-full gap-2"):
            for name, title, axis in CURVES:
                options = _options(title, axis)
                if name == "nis":
                    options["series"][0]["markLine"] = _level(CHI2_95_TWO, "")
                if name == "r95_m":
                    options["series"][0]["markLine"] = _level(goal_m, "goal")
                    options["yAxis"]["min"] = self._least_m
                self._charts[name] = ui.echart(options).classes("panel chart")

    def show(self, curve: Sequence[Mapping[str, Any]]) -> None:
        """Draw the curves, now and then."""
        self._count += 1
        if self._count % REDRAW_EVERY != 1:
            return
        for name, _, axis in CURVES:
            points = [
                [round(point["t_s"], 1), round(point[name], 3)]
                for point in curve
                if point[name] is not None
            ]
            if axis == "log":
                points = [[time_s, max(value, self._least_m)] for time_s, value in points]
            chart = self._charts[name]
            chart.options["series"][0]["data"] = points
            chart.update()


def _options(title: str, axis: str) -> dict[str, Any]:
    labels = {"fontSize": 10, "color": GREY, "hideOverlap": True}
    line = {"lineStyle": {"color": GREY}}
    faint = {"show": True, "lineStyle": {"color": GREY, "opacity": 0.25}}
    return {
        "title": {"text": title, "textStyle": {"fontSize": 12, "color": GREY}, "top": 0, "left": 0},
        "grid": {"left": 38, "right": 14, "top": 22, "bottom": 32},
        "animation": False,
        "xAxis": {
            "type": "value",
            "min": "dataMin",
            "max": "dataMax",
            "name": "seconds",
            "nameLocation": "middle",
            "nameGap": 18,
            "nameTextStyle": {"fontSize": 10, "color": GREY},
            "axisLine": line,
            "axisLabel": {**labels, "showMinLabel": False, "showMaxLabel": False},
            "splitLine": faint,
        },
        "yAxis": {
            "type": axis,
            "scale": True,
            "splitNumber": 3,
            "axisLine": line,
            "axisLabel": labels,
            "splitLine": faint,
        },
        "series": [
            {
                "type": "line",
                "showSymbol": False,
                "color": LINE,
                "lineStyle": {"width": 1.5},
                "data": [],
            }
        ],
    }


def _level(value: float, name: str) -> dict[str, Any]:
    """A line across a chart, with a name."""
    return {
        "silent": True,
        "symbol": "none",
        "lineStyle": {"color": "#c2570c"},
        "label": {
            "formatter": name,
            "position": "insideEndTop",
            "fontSize": 10,
            "color": "#c2570c",
        },
        "data": [{"yAxis": value}],
    }
