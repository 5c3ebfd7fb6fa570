"""The page: map, phase, numbers, ages, emitters, texts, curves and buttons.

Everything shown comes from outside sooner or later (an autopilot's text, an emitter's name), so
texts go into labels, which escape, and never into HTML.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from nicegui import ui

from companion.web.charts import Charts
from companion.web.hub import Hub
from companion.web.panels import AgeBars, EmitterList, Numbers, PhaseBar, TextList
from companion.web.search_map import SearchMap

REFRESH_S = 0.3
STALE_S = 2.0
"""Seconds without a picture after which the page says that the companion is silent."""
STYLE = Path(__file__).with_name("style.css")
BUTTONS = (
    ("hold", "HOLD", "#b45309", "Hold in place until RESUME?"),
    ("resume", "RESUME", "#15803d", "Fly the search again?"),
    ("return", "RETURN", "#b91c1c", "Return to home? The companion gives the vehicle up."),
)

Press = Callable[[str], None]


class Page:
    """One browser's page.

    Args:
        hub: What is known.
        tile_zooms: The least and the most zoom of the map tiles; None: there are none.
        press: Sends a button's name to the companion; None: no buttons.
        wall_s: The present, for noticing that pictures stopped.
    """

    def __init__(
        self,
        hub: Hub,
        *,
        tile_zooms: tuple[int, int] | None,
        press: Press | None,
        wall_s: Callable[[], float],
    ) -> None:
        self._hub = hub
        self._wall_s = wall_s
        self._shown, self._shown_at_s = -1, wall_s()
        ui.dark_mode(None)
        ui.add_css(STYLE)
        self._phase = PhaseBar()
        with ui.row().classes("w-full no-wrap max-lg:flex-wrap gap-2"):
            with ui.column().classes("w-full lg:w-2/3 gap-1"):
                self._map = SearchMap(hub.scene, tile_zooms)
                if press is not None:
                    _buttons(press)
            with ui.column().classes("w-full lg:w-1/3 gap-2 side"):
                self._numbers = Numbers()
                self._ages = AgeBars(hub.scene)
                self._emitters = EmitterList()
                self._texts = TextList()
        self._charts = Charts(hub.scene)
        ui.timer(REFRESH_S, self._refresh)

    def _refresh(self) -> None:
        hub, now_s = self._hub, self._wall_s()
        if hub.version == self._shown:
            if now_s - self._shown_at_s > STALE_S:
                self._phase.silent(now_s - self._shown_at_s)
            return
        self._shown, self._shown_at_s = hub.version, now_s
        picture: dict[str, Any] = hub.picture
        self._phase.show(picture)
        self._map.show(hub)
        self._numbers.show(picture)
        self._ages.show(picture)
        self._emitters.show(picture)
        self._texts.show(picture)
        self._charts.show(hub.curve)


def _buttons(press: Press) -> None:
    with ui.row().classes("w-full items-center justify-end gap-2 buttons"):
        for name, label, colour, question in BUTTONS:
            dialog = _confirmation(question, label, colour, partial(press, name))
            button = ui.button(label, color=colour, on_click=dialog.open)
            button.props(f"id=button-{name} unelevated text-color=white").classes("press")


def _confirmation(
    question: str, label: str, colour: str, confirmed: Callable[[], None]
) -> ui.dialog:
    with ui.dialog() as dialog, ui.card():
        ui.label(question)
        with ui.row():

            def do() -> None:
                """Close the question and do what was asked for."""
                dialog.close()
                confirmed()

            sure = ui.button(label, color=colour, on_click=do).classes("press")
            sure.props(f"id=confirm-{label.lower()} unelevated text-color=white")
            ui.button("Cancel", on_click=dialog.close).props("flat").classes("press")
    return dialog
