"""A hand-off for the ground team: the position as text, as a QR code and as files for their maps.

Imported when the button is pressed: geodetic positions need libraries of some size.
"""

from __future__ import annotations

import msgspec
import segno
from nicegui import ui

from companion.domain import TargetEstimate
from companion.geometry.coordinates import LocalOrigin
from companion.handoff import (
    Handoff,
    cot_event,
    degrees_text,
    geo_uri,
    geojson,
    handoff_of,
    kml,
    mgrs_text,
    minutes_text,
)
from companion.web.panels import copy_button

SENDER = "companion"


class LocalisedEmitter(msgspec.Struct, frozen=True):
    """A localised emitter, as the flight sends it."""

    emitter: str
    estimate: TargetEstimate
    origin: LocalOrigin
    unix_s: float

    @property
    def handoff(self) -> Handoff:
        """Position on the Earth, with its uncertainty and time."""
        return handoff_of(self.emitter, self.estimate, self.origin, self.unix_s)


def fill(found: object) -> None:
    """Fill the open dialog with the localised emitters."""
    handoffs = [each.handoff for each in msgspec.convert(found, list[LocalisedEmitter])]
    for handoff in handoffs:
        _show(handoff)
    ui.label("Files for maps and ATAK").classes("muted")
    with ui.row().classes("gap-2"):
        _file("GeoJSON", "handoff.geojson", geojson(handoffs).encode())
        _file("KML", "handoff.kml", kml(handoffs).encode())
        for handoff in handoffs:
            label = "CoT" if len(handoffs) == 1 else f"CoT {handoff.emitter}"
            _file(label, f"emitter-{handoff.emitter}.cot", cot_event(handoff, SENDER))


def _show(handoff: Handoff) -> None:
    """Show the position as text for the radio, and as a code for a phone."""
    radius_m, position_deg = handoff.absolute_r95_m, handoff.position_deg
    texts = {
        "grid": mgrs_text(position_deg, radius_m),
        "degrees": degrees_text(position_deg),
        "minutes": minutes_text(position_deg),
    }
    with ui.row().classes("w-full items-center gap-4"):
        with ui.column().classes("gap-1"):
            ui.label(f"Emitter {handoff.emitter}: {handoff.state}").classes("font-bold")
            for form, text in texts.items():
                with ui.row().classes("items-center gap-3"):
                    label = ui.label(text).classes("numbers").props(f"id={form}-{handoff.emitter}")
                    if form == "grid":
                        label.classes("grid-text")
                    copy_button(f"{form}-{handoff.emitter}")
            ui.label(f"Search the whole circle, {radius_m:.1f} m around it.").classes("numbers")
            ui.label(handoff.time_utc).classes("muted numbers")
        code = segno.make(geo_uri(position_deg), error="m").svg_data_uri(scale=4, light="#ffffff")
        picture = ui.element("img").classes("qr")
        picture.props["src"], picture.props["alt"] = code, f"QR code of {geo_uri(position_deg)}"


def _file(label: str, name: str, content: bytes) -> None:
    button = ui.button(label, color=None, on_click=lambda: ui.download.content(content, name))
    button.props(f"id=file-{label.lower().replace(' ', '-')} outline no-caps")
    button.classes("press plain")
