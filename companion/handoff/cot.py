"""Cursor on Target: what ATAK and WinTAK show when it arrives by UDP.

Source: MITRE, "Cursor on Target Message Router User's Guide", event schema 2.0; `ce` is the 95 %
circular error as TAK reads it.
"""

from __future__ import annotations

from xml.etree import ElementTree as ET

from companion.handoff.kml import printable
from companion.handoff.record import Handoff, utc_text

TYPE = "a-u-G"
"""Atom, unknown affiliation, ground: nothing is claimed of who carries the radio."""
HOW = "m-r"
"""Machine-reported."""
STALE_AFTER_S = 600.0
NO_VALUE = "9999999.0"
"""The schema's value for a height or a linear error that is unknown."""


def cot_event(handoff: Handoff, sender: str) -> bytes:
    """One event; an emitter keeps its `uid`, so the next event moves the same marker.

    Args:
        handoff: What is known.
        sender: Distinguishes two vehicles that find the same emitter.
    """
    emitter = printable(handoff.emitter)
    event = ET.Element(
        "event",
        version="2.0",
        uid=f"{printable(sender)}.emitter.{emitter}",
        type=TYPE,
        how=HOW,
        time=handoff.time_utc,
        start=handoff.time_utc,
        stale=utc_text(handoff.unix_s + STALE_AFTER_S),
    )
    ET.SubElement(
        event,
        "point",
        lat=f"{handoff.place_deg[0]:.7f}",
        lon=f"{handoff.place_deg[1]:.7f}",
        hae=NO_VALUE,  # we know the height above sea level, not above the ellipsoid
        ce=f"{handoff.r95_m:.1f}",
        le=NO_VALUE,
    )
    detail = ET.SubElement(event, "detail")
    ET.SubElement(detail, "contact", callsign=f"EMITTER {emitter}")
    remarks = f"{handoff.state}, R95 {handoff.r95_m:.1f} m, {handoff.measurements} measurements"
    ET.SubElement(detail, "remarks").text = remarks
    data: bytes = ET.tostring(event, encoding="utf-8", xml_declaration=True)
    return data
