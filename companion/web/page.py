"""The page: map, phase, numbers, ages, emitters, texts, curves and buttons.

Everything shown comes from outside sooner or later (an autopilot's text, an emitter's name), so
texts go into labels, which escape, and never into HTML.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from nicegui import ui

from companion.web.charts import Charts
from companion.web.hub import Hub
from companion.web.panels import AgeBars, EmitterList, Numbers, PhaseBar, TextList
from companion.web.search_map import SearchMap

REFRESH_S = 0.3
STALE_S = 2.0
"""Seconds without a picture after which the page says that the companion is silent."""
STYLE = """
.search-map { width: 100%; height: 58vh; min-height: 320px; }
.search-map.leaflet-container { background: #f8fafc; }
@media (min-width: 1024px) { .search-map { height: calc(100vh - 150px); } }
.nicegui-content { padding: 0.5rem; }
"""
BUTTONS = (
    ("hold", "HOLD", "warning", "Hold in place until RESUME?"),
    ("resume", "RESUME", "positive", "Fly the search again?"),
    ("return", "RETURN", "negative", "Return to home? The companion gives the vehicle up."),
)

Press = Callable[[str], None]


class Page:
    """One browser's page.

    Args:
        hub: What is known.
        has_tiles: Whether there are map tiles.
        press: Sends a button's name to the companion; None: no buttons.
        wall_s: The present, for noticing that pictures stopped.
    """

    def __init__(
        self, hub: Hub, *, has_tiles: bool, press: Press | None, wall_s: Callable[[], float]
    ) -> None:
        self._hub = hub
        self._wall_s = wall_s
        self._shown, self._shown_at_s = -1, wall_s()
        ui.add_css(STYLE)
        self._phase = PhaseBar()
        with ui.row().classes("w-full no-wrap max-lg:flex-wrap gap-2"):
            with ui.column().classes("w-full lg:w-2/3 gap-1"):
                self._map = SearchMap(hub.scene, has_tiles=has_tiles)
                self._map_buttons(press)
            with ui.column().classes("w-full lg:w-1/3 gap-2"):
                self._numbers = Numbers(hub.scene)
                self._ages = AgeBars(hub.scene)
                self._emitters = EmitterList()
                self._texts = TextList()
        self._charts = Charts()
        ui.timer(REFRESH_S, self._refresh)

    def _map_buttons(self, press: Press | None) -> None:
        with ui.row().classes("w-full items-center gap-2"):
            ui.button("Fit", on_click=lambda: self._map.run_method("fitAll")).props("outline dense")
            ui.space()
            if press is None:
                return
            for name, label, colour, question in BUTTONS:
                dialog = _confirmation(question, label, colour, partial(press, name))
                ui.button(label, color=colour, on_click=dialog.open).props(f"id=button-{name}")

    def _refresh(self) -> None:
        hub, now_s = self._hub, self._wall_s()
        if hub.version == self._shown:
            if now_s - self._shown_at_s > STALE_S:
                self._phase.silent(now_s - self._shown_at_s)
            return
        self._shown, self._shown_at_s = hub.version, now_s
        picture: dict[str, Any] = hub.picture
        self._phase.show(picture)
        self._map.show(picture, hub.track)
        self._numbers.show(picture)
        self._ages.show(picture)
        self._emitters.show(picture)
        self._texts.show(picture)
        self._charts.show(hub.curve)


def _confirmation(
    question: str, label: str, colour: str, confirmed: Callable[[], None]
) -> ui.dialog:
    with ui.dialog() as dialog, ui.card():
        ui.label(question)
        with ui.row():

            def do() -> None:
                dialog.close()
                confirmed()

            ui.button(label, color=colour, on_click=do).props(f"id=confirm-{label.lower()}")
            ui.button("Cancel", on_click=dialog.close).props("flat")
    return dialog
