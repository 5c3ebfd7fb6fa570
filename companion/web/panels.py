"""The panels beside the map: words, numbers, ages and lists."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from nicegui import ui

GOOD, WARN, BAD, QUIET = "#2a9d3f", "#d97706", "#c0262d", "#475569"
PHASE_COLOURS = {
    "normal": GOOD,
    "degraded": WARN,
    "hold": WARN,
    "yield": BAD,
    "handback": WARN,
    "finished": "#1f4e79",
}
SEVERITY_COLOURS = {"error": BAD, "warning": WARN, "notice": "#1f4e79"}
TEXTS_SHOWN = 12

Json = Mapping[str, Any]


class PhaseBar:
    """What it is doing, in words, across the top."""

    def __init__(self) -> None:
        with ui.row().classes("w-full items-center gap-2 rounded px-3 py-1") as self._bar:
            self._phase = ui.label("waiting for the companion").classes("text-lg font-bold")
            self._phase.props("id=phase")
            ui.space()
            self._mode = ui.label("").props("id=mode")
        self._colour(QUIET)

    def show(self, picture: Json) -> None:
        """Show a moment."""
        lost = "AUTOPILOT LOST  " if picture["is_link_lost"] else ""
        self._phase.set_text(lost + str(picture["phase_text"]))
        armed = "armed" if picture["is_armed"] else "disarmed"
        self._mode.set_text(f"{picture['mode']}, {armed}")
        colour = PHASE_COLOURS.get(str(picture["phase"]), QUIET)
        self._colour(BAD if picture["is_link_lost"] else colour)

    def silent(self, for_s: float) -> None:
        """Say that nothing comes from the companion any more."""
        self._phase.set_text(f"COMPANION SILENT for {for_s:.0f} s: what you see is old")
        self._colour(BAD)

    def _colour(self, colour: str) -> None:
        self._bar.style(f"background: {colour}; color: white")


class Numbers:
    """The figures that decide.

    Args:
        scene: What does not change.
    """

    def __init__(self, scene: Json) -> None:
        self._stop_radius_m = float(scene.get("stop_radius_m", 1.0))
        with ui.card().classes("w-full gap-0 p-2"):
            self._state = ui.label("nothing heard yet").classes("text-base font-bold")
            self._state.props("id=estimate-state")
            self._r95 = ui.label("R95 -").classes("text-3xl").props("id=r95")
            self._togo = ui.label("").props("id=time-to-go")
            self._where = ui.label("")
            self._offsets = ui.label("")
            self._vehicle = ui.label("")
            self._plan = ui.label("").props("id=plan")
            self._guard = ui.label("").props("id=guard").style(f"color: {WARN}")

    def show(self, picture: Json) -> None:
        """Show a moment."""
        estimate = picture["estimate"]
        if estimate is not None:
            self._state.set_text(str(estimate["words"]))
            self._r95.set_text(f"R95 {estimate['r95_m']:.2f} m")
            east, north = estimate["place"]
            self._where.set_text(f"east {east:.1f} m, north {north:.1f} m")
            self._offsets.set_text(
                f"offsets: range {estimate['range_offset_m']:+.2f} m, "
                f"bearing {math.degrees(estimate['bearing_offset_rad']):+.1f} deg; "
                f"{100 * picture['nlos_share']:.0f} % reflected"
            )
        togo_s = picture.get("time_to_go_s")
        self._togo.set_text("" if togo_s is None else f"about {togo_s:.0f} s to go")
        height = "-" if picture["height_m"] is None else f"{picture['height_m']:.1f} m"
        self._vehicle.set_text(f"height {height}, flown {picture['distance_m']:.0f} m")
        waypoint = picture["waypoint"]
        plan = "" if waypoint is None else f"next: {waypoint['reason']}, {waypoint['detail']}"
        self._plan.set_text(plan)
        self._guard.set_text("; ".join(picture["guard"]))


class AgeBars:
    """How old each input is; a bar that is full is too old, and red.

    Args:
        scene: What does not change.
    """

    def __init__(self, scene: Json) -> None:
        self._old_after_s: Mapping[str, float] = scene.get("old_after_s", {})
        self._bars: dict[str, tuple[ui.linear_progress, ui.label]] = {}
        with ui.card().classes("w-full gap-1 p-2"):
            for name in self._old_after_s:
                with ui.row().classes("w-full items-center no-wrap gap-2"):
                    ui.label(name).classes("w-20")
                    bar = ui.linear_progress(0.0, show_value=False).props(f"id=age-{name}")
                    self._bars[name] = (bar, ui.label("-").classes("w-16"))

    def show(self, picture: Json) -> None:
        """Show a moment."""
        for name, (bar, label) in self._bars.items():
            age_s = picture["ages_s"].get(name)
            share = 1.0 if age_s is None else min(1.0, age_s / self._old_after_s[name])
            colour = "negative" if share >= 1.0 else "warning" if share > 0.6 else "positive"
            bar.set_value(share)
            bar.props(f"color={colour}")
            label.set_text("never" if age_s is None else f"{age_s:.1f} s")


class EmitterList:
    """Every emitter heard, and how far it is located."""

    def __init__(self) -> None:
        with ui.card().classes("w-full gap-0 p-2"):
            self._lines = ui.column().classes("gap-0").props("id=emitters")
        self._shown: list[str] = []

    def show(self, picture: Json) -> None:
        """Show a moment."""
        lines = [_emitter_line(emitter) for emitter in picture.get("emitters", [])]
        if lines == self._shown:
            return
        self._shown = lines
        self._lines.clear()
        with self._lines:
            for line in lines:
                ui.label(line)


def _emitter_line(emitter: Json) -> str:
    r95_m = emitter.get("r95_m")
    known = "" if r95_m is None else f", R95 {r95_m:.1f} m"
    return f"emitter {emitter['name']}: {emitter['state']}{known}"


class TextList:
    """What was said to the operator, newest first."""

    def __init__(self) -> None:
        with ui.card().classes("w-full gap-0 p-2"):
            self._lines = ui.column().classes("gap-0").props("id=texts")
        self._shown: list[Any] = []

    def show(self, picture: Json) -> None:
        """Show a moment."""
        texts = list(picture.get("texts", []))[-TEXTS_SHOWN:]
        if texts == self._shown:
            return
        self._shown = texts
        self._lines.clear()
        with self._lines:
            for time_s, severity, text in reversed(texts):
                label = ui.label(f"{time_s:6.1f} s  {text}").classes("text-sm")
                label.style(f"color: {SEVERITY_COLOURS.get(severity, QUIET)}")
