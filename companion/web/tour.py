"""Five steps through the page for somebody who sees it for the first time."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass

from nicegui import ui


@dataclass(frozen=True, slots=True)
class Step:
    """What is shown, and what is said of it."""

    selector: str
    title: str
    text: str


STEPS = (
    Step(
        "#bar",
        "What happens now",
        "The bar says what the companion does. The line below says what you do next.",
    ),
    Step(
        ".search-map",
        "The map",
        "Blue is the vehicle. Red is where the emitter may be. Green rings are ranges that are "
        "believed; orange ones came by reflection.",
    ),
    Step(
        "#estimate-panel",
        "How sure it is",
        "R95 is the radius that holds the emitter in 95 of 100 cases. The large number "
        "holds for everybody; the relative one for the vehicle, in this flight.",
    ),
    Step(
        "#age-panel",
        "Is it all fresh?",
        "Each bar is the age of an input. A red one is too old to fly on: then it holds.",
    ),
    Step(
        ".buttons",
        "Taking part",
        "Your mode switch stands above everything here. HAND OVER appears when the place is "
        "known, for the team on the ground.",
    ),
)
SHOW = """
document.querySelectorAll(".toured").forEach(each => each.classList.remove("toured"));
const shown = document.querySelector(%s);
if (shown) { shown.classList.add("toured"); shown.scrollIntoView({block: "center"}); }
"""


class Tour:
    """A button, and a card at the lower edge while the tour goes on."""

    def __init__(self) -> None:
        self._at = 0
        button = ui.button("Tour", color=None, on_click=lambda: self._go(0))
        button.props("id=button-tour outline no-caps").classes("press plain")
        with ui.element("aside").classes("tour panel").props('aria-live="polite"') as self._card:
            self._title = ui.label("").classes("font-bold")
            self._text = ui.label("")
            with ui.row().classes("w-full justify-end gap-2"):
                self._button("End", lambda: self._go(len(STEPS)), "tour-end")
                self._button("Next", lambda: self._go(self._at + 1), "tour-next")
        self._card.set_visibility(False)

    @staticmethod
    def _button(label: str, act: Callable[[], None], name: str) -> None:
        button = ui.button(label, color=None, on_click=act)
        button.props(f"id={name} outline no-caps").classes("press plain")

    def _go(self, at: int) -> None:
        """Show a step; after the last one nothing."""
        self._at = at
        is_going_on = at < len(STEPS)
        self._card.set_visibility(is_going_on)
        if is_going_on:
            step = STEPS[at]
            self._title.set_text(f"{at + 1} of {len(STEPS)}: {step.title}")
            self._text.set_text(step.text)
        ui.run_javascript(SHOW % json.dumps(STEPS[at].selector if is_going_on else "#no-step"))
