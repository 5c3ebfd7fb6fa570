"""KML 2.2 (OGC 07-147r2): what Google Earth, ATAK and QGroundControl open."""

from __future__ import annotations

from collections.abc import Iterable
from xml.etree import ElementTree as ET

from companion.handoff.record import Degrees, Handoff

NAMESPACE = "http://www.opengis.net/kml/2.2"
ELLIPSE_LINE = "ff00a5ff"
"""Colours are aabbggrr in KML: orange."""
ELLIPSE_FILL = "4000a5ff"


def kml(handoffs: Iterable[Handoff]) -> str:
    """A document with a placemark per place and one per ellipse."""
    root = ET.Element("kml", xmlns=NAMESPACE)
    document = ET.SubElement(root, "Document")
    ET.SubElement(document, "name").text = "Emitters"
    style = ET.SubElement(document, "Style", id="ellipse")
    ET.SubElement(ET.SubElement(style, "LineStyle"), "color").text = ELLIPSE_LINE
    ET.SubElement(ET.SubElement(style, "PolyStyle"), "color").text = ELLIPSE_FILL
    for handoff in handoffs:
        _add(document, handoff)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _add(document: ET.Element, handoff: Handoff) -> None:
    name = printable(handoff.emitter)
    about = (
        f"{handoff.state}, R95 {handoff.r95_m:.1f} m, "
        f"{handoff.measurements} measurements, {handoff.time_utc}"
    )
    _add_point(document, f"emitter {name}", about, handoff.place_deg)
    if handoff.alternative_deg is not None:
        text = f"emitter {name}, second place"
        _add_point(document, text, about, handoff.alternative_deg)
    placemark = _placemark(document, f"emitter {name}, 95 %", about)
    ET.SubElement(placemark, "styleUrl").text = "#ellipse"
    polygon = ET.SubElement(placemark, "Polygon")
    boundary = ET.SubElement(ET.SubElement(polygon, "outerBoundaryIs"), "LinearRing")
    ring = (*handoff.ellipse_deg, handoff.ellipse_deg[0])
    ET.SubElement(boundary, "coordinates").text = " ".join(map(_coordinates, ring))


def _add_point(document: ET.Element, name: str, about: str, place: Degrees) -> None:
    placemark = _placemark(document, name, about)
    ET.SubElement(ET.SubElement(placemark, "Point"), "coordinates").text = _coordinates(place)


def _placemark(document: ET.Element, name: str, about: str) -> ET.Element:
    placemark = ET.SubElement(document, "Placemark")
    ET.SubElement(placemark, "name").text = name
    ET.SubElement(placemark, "description").text = about
    return placemark


def _coordinates(place: Degrees) -> str:
    """Longitude, latitude; without an altitude a viewer lays it on the ground."""
    return f"{place[1]:.7f},{place[0]:.7f}"


def printable(text: str) -> str:
    """`text` without what XML 1.0 cannot hold (control characters, lone surrogates)."""
    return "".join(c if c.isprintable() else "?" for c in text)
