"""Buttons of the page.

HOLD, RESUME, RETURN and GRANT show the reason while disabled, ask for confirmation, and show the
answer; HAND OVER shows the hand-off for ground teams.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from nicegui import ui

from companion.web.panels import DONE, Json

Press = Callable[[str], None]

BUTTONS = (
    ("hold", "HOLD", "#b45309", "Hold in place until RESUME?"),
    ("resume", "RESUME", "#15803d", "Resume the search?"),
    ("return", "RETURN", "#b91c1c", "Return home? The companion ends its control."),
    (
        "grant",
        "GRANT",
        "#1f4e79",
        "Let the companion fly again once you select the mode? After a failsafe in OFFBOARD "
        "PX4 returns to it at once, and the search continues.",
    ),
)
ANSWER_S = 1.0
"""Time after which an answer is reported as missing."""
FORGOTTEN_S = 10.0
"""Time after which a missing answer is ignored."""


class CommandButtons:
    """The buttons; `press` sends a button's name to the companion."""

    def __init__(self, press: Press) -> None:
        self._press = press
        self._shown_s = 0.0
        """Flight time of the moment on the page."""
        self._buttons: dict[str, tuple[ui.button, ui.label]] = {}
        self._awaited: dict[str, tuple[float, float, bool]] = {}
        """Flight and monotonic time of each press by label, and True if reported missing."""
        for name, label, colour, question in BUTTONS:
            dialog = _confirmation(question, label, colour, partial(self._send, name, label))
            with ui.column().classes("command gap-0 items-center"):
                button = ui.button(label, color=colour, on_click=dialog.open).classes("press")
                button.props(f"id=button-{name} unelevated text-color=white")
                reason = ui.label("").classes("muted reason").props(f"id=reason-{name}")
            self._buttons[name] = (button, reason)

    def show(self, picture: Mapping[str, Any]) -> None:
        """Enable the buttons that have an effect now, and show the answers to pressed ones."""
        self._shown_s = picture["t_s"]
        for name, (button, reason) in self._buttons.items():
            objection = picture["objections"][name]
            button.set_enabled(objection is None)
            reason.set_text(objection or "")
        for time_s, _, text in picture["texts"]:
            label = text.partition(" ")[0]
            if label in self._awaited and time_s >= self._awaited[label][0]:
                del self._awaited[label]
                ui.notify(text, type="negative" if " refused" in text else "positive")

    def check_answers(self) -> None:
        """Warn once of every command that was not answered in time, and forget old ones."""
        now_s = time.monotonic()
        for label, (flight_s, pressed_s, is_missed) in list(self._awaited.items()):
            if now_s - pressed_s > FORGOTTEN_S:
                del self._awaited[label]
            elif now_s - pressed_s > ANSWER_S and not is_missed:
                self._awaited[label] = (flight_s, pressed_s, True)
                ui.notify(f"{label}: no answer from the companion yet", type="warning")

    def _send(self, name: str, label: str) -> None:
        self._awaited[label] = (self._shown_s, time.monotonic(), False)
        self._press(name)


def _confirmation(
    question: str, label: str, colour: str, confirmed: Callable[[], None]
) -> ui.dialog:
    with ui.dialog() as dialog, ui.card():
        ui.label(question)
        with ui.row():

            def do() -> None:
                dialog.close()
                confirmed()

            sure = ui.button(label, color=colour, on_click=do).classes("press")
            sure.props(f"id=confirm-{label.lower()} unelevated text-color=white")
            cancel = ui.button("Cancel", color=None, on_click=dialog.close)
            cancel.props("flat").classes("press plain")
    return dialog


class HandoffButton:
    """HAND OVER, for the ground team; visible once an emitter is localised."""

    def __init__(self) -> None:
        self._found: object = []
        with ui.dialog() as self._dialog, ui.card().classes("handoff"):
            self._content = ui.column().classes("w-full gap-2")
            with ui.row().classes("w-full justify-end"):
                close = ui.button("Close", color=None, on_click=self._dialog.close)
                close.props("outline no-caps").classes("press plain")
        button = ui.button("HAND OVER", color=DONE, on_click=self._open)
        self._button = button.props("id=button-handoff unelevated text-color=white")
        self._button.classes("press").set_visibility(False)

    def show(self, picture: Json) -> None:
        """Set the localised emitters; an open dialog stays as it was."""
        self._found = picture.get("found", [])
        self._button.set_visibility(bool(self._found))

    def _open(self) -> None:
        from companion.web.handoff_dialog import fill

        self._content.clear()
        with self._content:
            fill(self._found)
        self._dialog.open()
