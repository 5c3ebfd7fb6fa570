"""The panels next to the map (words, numbers, ages, lists), and the curves over time."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import msgspec
from nicegui import ui

from companion.domain import radii_text
from companion.geometry.polygons import CHI2_95_TWO

REPLAYED = "#6b21a8"
GOOD, WARN, BAD, QUIET, DONE = "#15803d", "#b45309", "#b91c1c", "#475569", "#1f4e79"
"""Background colours behind white text."""
PHASE_COLOURS = {
    "normal": GOOD,
    "degraded": WARN,
    "hold": WARN,
    "yield": BAD,
    "handback": WARN,
    "finished": DONE,
}
UNDER_WAY = frozenset({"normal", "degraded", "hold"})
"""Phases with a next waypoint and a time to go."""
SEVERITIES = frozenset({"error", "warning", "notice"})
"""Severities with their own colour."""
TEXTS_SHOWN = 30

Json = Mapping[str, Any]


def _panel(title: str = "") -> ui.element:
    panel = ui.element("section").classes("panel")
    if title:
        with panel, ui.element("h2"):
            ui.label(title)
    return panel


class PhaseBar:
    """The phase, across the top."""

    def __init__(self, replay: str | None) -> None:
        """`replay` is the banner of a past flight; None if the flight is live."""
        if replay is not None:
            banner = ui.label(replay).classes("w-full rounded px-3 py-1 font-bold")
            banner.props("id=replay role=status").style(f"background: {REPLAYED}; color: white")
        bar = ui.row().classes("w-full items-center justify-between gap-x-4 gap-y-0 rounded")
        with bar.classes("px-3 py-2").props("role=status id=bar") as self._bar:
            with ui.row().classes("items-baseline gap-x-3 gap-y-0").props("id=phase"):
                self._phase = ui.label("waiting for the companion").classes("text-lg font-bold")
                self._detail = ui.label("")
            self._mode = ui.label("").props("id=mode")
            self._time = ui.label("").classes("numbers").props("id=time")
            self._next = ui.label("").classes("w-full text-base").props("id=next-step")
        self._colour(QUIET)

    def show(self, picture: Json) -> None:
        """Show the flight at one moment, as `companion.view` describes it."""
        is_lost = picture["is_link_lost"]
        is_over = picture.get("is_over", False)
        head = "FLIGHT OVER: " if is_over else "AUTOPILOT LOST: " if is_lost else ""
        self._phase.set_text(head + picture["phase_text"])
        self._detail.set_text(picture["phase_detail"])
        self._next.set_text(picture["next_step"])
        armed = "armed" if picture["is_armed"] else "disarmed"
        self._mode.set_text(f"{picture['mode']}, {armed}")
        if (unix_s := picture.get("unix_s")) is not None:
            clock = datetime.fromtimestamp(unix_s, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
            self._time.set_text(f"{clock}, {picture['t_s']:.0f} s")
        self._colour(BAD if is_lost else PHASE_COLOURS.get(picture["phase"], QUIET))

    def _colour(self, colour: str) -> None:
        self._bar.style(f"background: {colour}; color: white")


class Numbers:
    """The figures that matter for the search."""

    NAMES = (
        *("relative", "time to go", "position", "grid", "local", "offsets", "reflected"),
        *("vehicle", "battery", "next", "fence"),
    )

    def __init__(self, scene: Json) -> None:
        has_search = scene.get("pod_colours") is not None
        with _panel("Estimate").props("id=estimate-panel"):
            with ui.row().classes("items-baseline gap-x-3 gap-y-0 beside-copy"):
                self._r95 = ui.label("R95 -").classes("text-3xl numbers").props("id=r95")
                ui.label("absolute").classes("muted").props("id=r95-kind")
                self._state = ui.label("nothing heard yet").classes("text-base font-bold")
                self._state.props("id=estimate-state")
                self._copy = copy_button("value-position", "value-grid")
                self._copy.set_visibility(False)
            self._values: dict[str, ui.label] = {}
            with ui.element("div").classes("figures numbers"):
                for name in ("searched", *self.NAMES) if has_search else self.NAMES:
                    ui.label(name).classes("muted")
                    self._values[name] = ui.label("-").props(f"id=value-{name.replace(' ', '-')}")
            self._guard = ui.label("").props("id=guard").style("color: var(--warning)")

    def show(self, picture: Json) -> None:
        """Show the flight at one moment, as `companion.view` describes it."""
        values = {**_of_estimate(picture), **_of_vehicle(picture), **_of_plan(picture)}
        values["searched"] = picture["searched"] or "-"
        self._copy.set_visibility("position" in values)
        for name, label in self._values.items():
            label.set_text(values.get(name, "-"))
        colour = "inherit" if picture["fence"]["refusal"] is None else "var(--error)"
        self._values["fence"].style(f"color: {colour}")
        estimate = picture["estimate"]
        if estimate is not None:
            self._state.set_text(str(estimate["text"]))
            self._r95.set_text(f"R95 {estimate['absolute_r95_m']:.2f} m")
        guard = "; ".join(picture["guard"])
        self._guard.set_text(f"guard: {guard}" if guard else "")


def _of_estimate(picture: Json) -> dict[str, str]:
    estimate = picture["estimate"]
    if estimate is None:
        return {}
    east, north = estimate["position"]
    return {
        **_on_earth(estimate, picture.get("frame")),
        "relative": f"{estimate['r95_m']:.2f} m to vehicle ({estimate['own_text']})",
        "local": f"{east:.1f} m east, {north:.1f} m north",
        "offsets": f"range {estimate['range_offset_m']:+.2f} m, "
        f"bearing {math.degrees(estimate['bearing_offset_rad']):+.1f}°",
        "reflected": f"{100 * picture['nlos_share']:.0f} % of the ranges",
    }


def _on_earth(estimate: Json, frame: Json | None) -> dict[str, str]:
    """Return the estimate's coordinates for others; empty while the origin is unknown."""
    if frame is None:
        return {}
    from companion.geometry.coordinates import LocalOrigin
    from companion.handoff import degrees_text, mgrs_text  # some size, and in this process only

    origin = msgspec.convert(frame, LocalOrigin)
    latitude_deg, longitude_deg, _ = origin.geodetic_from_enu((*estimate["position"], 0.0))
    position_deg = (latitude_deg, longitude_deg)
    grid = mgrs_text(position_deg, estimate["absolute_r95_m"])
    return {"position": degrees_text(position_deg), "grid": grid}


COPY = """() => {
  const shown = %s.map(id => document.getElementById(id));
  const text = shown.map(each => each.innerText).join("  ");
  if (navigator.clipboard) {
    navigator.clipboard.writeText(text);
  } else {  // of a page without TLS, beyond this computer
    const box = document.body.appendChild(document.createElement("textarea"));
    box.value = text;
    box.select();
    document.execCommand("copy");
    box.remove();
  }
  emit();
}"""


def copy_button(*names: str) -> ui.button:
    """Return a button that copies the texts of elements, by their ids, in the browser."""
    button = ui.button("Copy", color=None).props(f"id=copy-{names[0]} outline no-caps dense")
    button.on("click", lambda: ui.notify("copied"), js_handler=COPY % json.dumps(names))
    return button.classes("press plain")


def _of_vehicle(picture: Json) -> dict[str, str]:
    height_m, battery_pct = picture["height_m"], picture["battery_pct"]
    height = "height unknown" if height_m is None else f"{height_m:.1f} m above home"
    battery = "unknown" if battery_pct is None else f"{battery_pct:.0f} %"
    return {"vehicle": f"{height}, {picture['distance_m']:.0f} m flown", "battery": battery}


def _of_plan(picture: Json) -> dict[str, str]:
    fence = picture["fence"]
    values = {"fence": fence["text"]}
    if fence["refusal"] is not None:
        values["fence"] = fence["refusal"]
    elif fence["missing"]:
        values["fence"] = f"waiting for {' and '.join(fence['missing'])}"
    if picture["phase"] not in UNDER_WAY:
        return values
    togo_s, waypoint = picture.get("time_to_go_s"), picture["waypoint"]
    if togo_s is not None:
        values["time to go"] = f"about {togo_s:.0f} s"
    if waypoint is not None:
        values["next"] = f"{waypoint['reason']}: {waypoint['detail']}"
    return values


class AgeBars:
    """Age of each input; a full bar is too old, and red."""

    def __init__(self, scene: Json) -> None:
        self._old_after_s: Mapping[str, float] = scene.get("old_after_s", {})
        self._bars: dict[str, tuple[ui.linear_progress, ui.label]] = {}
        with _panel("Age of the inputs").props("id=age-panel"):
            for name, old_after_s in self._old_after_s.items():
                with ui.row().classes("w-full items-center no-wrap gap-2 numbers"):
                    ui.label(name).classes("w-20 shrink-0")
                    bar = ui.linear_progress(0.0, show_value=False, size="8px")
                    bar.props(f'id=age-{name} rounded aria-label="age of {name}"')
                    label = ui.label("-").classes("w-28 shrink-0 text-right whitespace-nowrap")
                    label.tooltip(f"not used for guidance from {old_after_s:g} s on")
                    self._bars[name] = (bar, label)

    def show(self, picture: Json) -> None:
        """Show the flight at one moment, as `companion.view` describes it."""
        is_over = picture.get("is_over", False)
        is_finished = picture["phase"] == "finished"
        for name, (bar, label) in self._bars.items():
            age_s, limit_s = picture["ages_s"].get(name), self._old_after_s[name]
            share = 0.0 if age_s is None else min(1.0, age_s / limit_s)
            colour = "negative" if share >= 1.0 else "warning" if share > 0.6 else "positive"
            if is_over or (is_finished and name == "ranging"):
                colour = "grey"  # ranging has ended, so its age is no fault
            bar.set_value(round(share, 2))  # 4e-14 is not a number to a screen reader
            bar.props(f"color={colour}")
            label.set_text("not heard" if age_s is None else f"{age_s:.1f} of {limit_s:g} s")


class _ChangingLines:
    """Lines of a panel, redrawn only when they change; hidden while there are none."""

    def __init__(self, panel: ui.element, classes: str, name: str) -> None:
        self._panel = panel
        with panel:
            self._lines = ui.column().classes(classes).props(f"id={name} tabindex=0")
        panel.set_visibility(False)
        self._shown: list[Any] = []

    def _show(self, lines: list[Any], draw: Callable[[Any], object]) -> None:
        if lines == self._shown:
            return
        self._shown = lines
        self._panel.set_visibility(bool(lines))
        self._lines.clear()
        with self._lines:
            for line in lines:
                draw(line)


class EmitterList(_ChangingLines):
    """Every emitter heard, and its radii."""

    def __init__(self) -> None:
        super().__init__(_panel("Emitters"), "gap-0", "emitters")

    def show(self, picture: Json) -> None:
        """Show the flight at one moment, as `companion.view` describes it."""
        lines = []
        for emitter in picture.get("emitters", []):
            radii = emitter.get("absolute_r95_m"), emitter.get("r95_m")
            known = "" if None in radii else f", {radii_text(*radii)}"
            lines.append(f"{emitter['name']}: {emitter['state']}{known}")
        self._show(lines, lambda line: ui.label(line).classes("numbers"))


class RadioList(_ChangingLines):
    """Every radio with a native format, and its state."""

    def __init__(self) -> None:
        super().__init__(_panel("Radios"), "gap-0", "radios")

    def show(self, picture: Json) -> None:
        """Show the flight at one moment, as `companion.view` describes it."""
        lines = [f"{name}: {words}" for name, words in picture.get("radios", [])]
        self._show(lines, lambda line: ui.label(line).classes("numbers"))


class TextList(_ChangingLines):
    """Texts for the operator, newest first."""

    def __init__(self) -> None:
        panel = _panel("Messages").classes("grows")
        super().__init__(panel, "gap-0 texts text-sm numbers", "texts")

    def show(self, picture: Json) -> None:
        """Show the flight at one moment, as `companion.view` describes it."""
        self._show(list(picture.get("texts", []))[: -TEXTS_SHOWN - 1 : -1], self._draw)

    @staticmethod
    def _draw(line: tuple[float, str, str]) -> None:
        time_s, severity, text = line
        with ui.element("div").classes("row"):
            ui.label(f"{time_s:.1f} s")
            label = ui.label(text)
            if severity in SEVERITIES:
                label.style(f"color: var(--{severity})")


CURVES = (
    ("r95_m", "R95 relative, m", "log"),
    ("range_innovation", "Range residual, m", "value"),
    ("range_offset_m", "Range offset, m", "value"),
    ("nis", "NIS, expected: 95 % below 6", "value"),
)
MIN_GOAL_SHARE = 0.1
"""Start of the logarithmic axis of R95, as a share of the goal."""
REDRAW_EVERY = 4
"""Curves change slowly: redrawn with every fourth picture."""
GREY, LINE = "#7c8a9a", "#3b82f6"
"""Colours of lines, visible on white and on black; texts have their colour from the style sheet."""


class Charts:
    """Four small charts, side by side on a desk and one below the other on a phone."""

    def __init__(self, scene: Mapping[str, Any]) -> None:
        self._count = 0
        self._charts: dict[str, ui.echart] = {}
        goal_m = float(scene.get("stop_radius_m", 1.0))
        self._least_m = MIN_GOAL_SHARE * goal_m
        with ui.row().classes("w-full gap-2"):
            for name, title, axis in CURVES:
                options = _options(title, axis)
                if name == "nis":
                    options["series"][0]["markLine"] = _level(CHI2_95_TWO, "")
                if name == "r95_m":
                    options["series"][0]["markLine"] = _level(goal_m, "goal")
                    options["yAxis"]["min"] = self._least_m
                self._charts[name] = ui.echart(options, renderer="svg").classes("panel chart")

    def show(self, curve: Sequence[Mapping[str, Any]]) -> None:
        """Draw the curves with every fourth picture."""
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
    lines = {"axisLine": line, "splitLine": faint}
    curve = {"type": "line", "showSymbol": False, "color": LINE, "lineStyle": {"width": 1.5}}
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
            "axisLabel": {**labels, "showMinLabel": False, "showMaxLabel": False},
            **lines,
        },
        "yAxis": {"type": axis, "scale": True, "splitNumber": 3, "axisLabel": labels, **lines},
        "series": [{**curve, "data": []}],
    }


def _level(value: float, name: str) -> dict[str, Any]:
    colour = {"color": "#c2570c"}
    return {
        "silent": True,
        "symbol": "none",
        "lineStyle": colour,
        "label": {"formatter": name, "position": "insideEndTop", "fontSize": 10, **colour},
        "data": [{"yAxis": value}],
    }
