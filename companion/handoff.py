"""Emitter position for ground teams: GeoJSON (RFC 7946), KML 2.2 (OGC 07-147r2), CoT and MGRS text.

GeoJSON and KML hold the position, its 95 % ellipse and the second position; Google Earth, ATAK and
QGroundControl open the KML. Cursor on Target (CoT) is the format of TAK's maps, MGRS the grid text
that ground teams read out over the radio.

A ground team goes to the position with its own receiver, whose error is independent of the
vehicle's. So ellipses, the grid and the radius named first are absolute; the relative radius
is added, for sending the vehicle back.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any
from xml.etree import ElementTree as ET

import mgrs

from companion.domain import PositionAccuracy, TargetEstimate, radii_text
from companion.geometry.coordinates import LocalOrigin
from companion.geometry.polygons import Point, ellipse_95
from companion.guidance.commands import ReportResult

Degrees = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Handoff:
    """Position of an emitter, with its uncertainty and time."""

    emitter: str
    """Id or name of the emitter, as the operator knows it; any text, the formats escape it."""
    state: str
    position_deg: Degrees
    altitude_m: float
    """Altitude of the emitter above mean sea level, assumed or estimated."""
    r95_m: float
    """Relative radius: it holds the emitter with 95 % probability, rival positions included, for
    the vehicle that measured it."""
    absolute_r95_m: float
    """Absolute radius, the same on the Earth, for other vehicles and people."""
    own: PositionAccuracy
    """Accuracy of the vehicle position, which is included in the absolute radius."""
    ellipse_deg: tuple[Degrees, ...]
    """Absolute 95 % ellipse of the main position."""
    alternative_deg: Degrees | None
    """Second position while the state is ambiguous."""
    measurements: int
    unix_s: float
    altitude_sigma_m: float | None = None
    """Standard deviation of the altitude where it is estimated, vehicle height included."""

    @property
    def time_utc(self) -> str:
        """Time of the estimate, ISO 8601."""
        return utc_text(self.unix_s)

    @property
    def radii(self) -> str:
        """Text of both radii, and of the GNSS accuracy in the absolute one."""
        return radii_text(self.absolute_r95_m, self.r95_m, self.own)


def utc_text(unix_s: float) -> str:
    """Return seconds since 1970 as ISO 8601 in UTC, whole seconds."""
    return datetime.fromtimestamp(unix_s, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def handoff_of(
    emitter: str, estimate: TargetEstimate, origin: LocalOrigin, unix_s: float
) -> Handoff:
    """Return the hand-off of an estimate."""
    height_m = estimate.height_m

    def degrees(point: Point) -> Degrees:
        return origin.geodetic_from_enu((*point, height_m))[:2]

    alternative = estimate.alternative_enu_m
    ellipse = ellipse_95(estimate.position_enu_m, estimate.absolute_covariance_m2)
    return Handoff(
        emitter=emitter,
        state=estimate.state.value,
        position_deg=degrees(estimate.position_enu_m),
        altitude_m=origin.altitude_m + height_m,
        r95_m=estimate.r95_m,
        absolute_r95_m=estimate.absolute_r95_m,
        own=estimate.own,
        ellipse_deg=tuple(degrees(point) for point in ellipse.corners_enu_m()),
        alternative_deg=None if alternative is None else degrees(alternative),
        measurements=estimate.measurements,
        unix_s=unix_s,
        altitude_sigma_m=estimate.absolute_height_sigma_m,
    )


def degrees_text(position_deg: Degrees) -> str:
    """Return a WGS84 position in decimal degrees, latitude first, to about a decimetre."""
    return f"{position_deg[0]:.6f}, {position_deg[1]:.6f}"


def minutes_text(position_deg: Degrees) -> str:
    """Return a WGS84 position in degrees and minutes, to 2 m: `47° 23.881' N, 8° 32.767' E`."""
    return f"{_minutes(position_deg[0], 'NS')}, {_minutes(position_deg[1], 'EW')}"


def _minutes(angle_deg: float, signs: str) -> str:
    thousandths = round(abs(angle_deg) * 60_000)
    degrees, minutes = divmod(thousandths, 60_000)
    return f"{degrees}° {minutes / 1000:06.3f}' {signs[angle_deg < 0.0]}"


MIN_DIGITS, MAX_DIGITS = 1, 5
"""Digit pairs of a grid reference: one is 10 km, five are 1 m."""


def geo_uri(position_deg: Degrees) -> str:
    """Return a WGS84 position as phones open it on their maps (RFC 5870), to about a decimetre."""
    return f"geo:{position_deg[0]:.6f},{position_deg[1]:.6f}"


def mgrs_text(position_deg: Degrees, r95_m: float) -> str:
    """Return a WGS84 position as MGRS with spaces, no finer than its radius: `32T PT 6894 3510`.

    The named square contains the position, and is at most as large as R95 (1 m at least). The poles
    are in UPS squares.
    """
    digits = MAX_DIGITS - math.floor(math.log10(min(max(r95_m, 1.0), 1e4)))
    digits = min(max(digits, MIN_DIGITS), MAX_DIGITS)
    text = mgrs.MGRS().toMGRS(*position_deg, MGRSPrecision=digits).lstrip("0")
    head, east, north = text[: -2 * digits], text[-2 * digits : -digits], text[-digits:]
    return f"{head[:-2]} {head[-2:]} {east} {north}"


DECIMALS = 7
"""Decimals of degrees, a centimetre; RFC 7946 section 11.2 wants no more than is known."""


def geojson(handoffs: Iterable[Handoff]) -> str:
    """Return a feature collection with up to three features per emitter."""
    features = [each for handoff in handoffs for each in _features(handoff)]
    return json.dumps({"type": "FeatureCollection", "features": features}, indent=2) + "\n"


def _features(handoff: Handoff) -> list[dict[str, object]]:
    about: dict[str, object] = {
        "emitter": handoff.emitter,
        "state": handoff.state,
        "absolute_r95_m": round(handoff.absolute_r95_m, 2),
        "r95_m": round(handoff.r95_m, 2),
        "own_sigma_m": round(handoff.own.horizontal_m, 2),
        "own_sigma_told": handoff.own.is_reported,
        "altitude_amsl_m": round(handoff.altitude_m, 2),  # a third coordinate would be ellipsoidal
        "measurements": handoff.measurements,
        "time": handoff.time_utc,
    }
    if handoff.altitude_sigma_m is not None:
        about["altitude_sigma_m"] = round(handoff.altitude_sigma_m, 2)
    # A ring is closed, and its inside lies to the left (RFC 7946 section 3.1.6).
    ring = [_position(point) for point in (*handoff.ellipse_deg, handoff.ellipse_deg[0])]
    shapes: list[tuple[str, str, list[Any]]] = [
        ("estimate", "Point", _position(handoff.position_deg)),
        ("ellipse_95", "Polygon", [ring]),
    ]
    if handoff.alternative_deg is not None:
        shapes.append(("alternative", "Point", _position(handoff.alternative_deg)))
    return [
        feature(shape, coordinates, {**about, "kind": kind}) for kind, shape, coordinates in shapes
    ]


def feature(kind: str, coordinates: list[Any], about: Mapping[str, object]) -> dict[str, object]:
    """Return one feature of GeoJSON."""
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": dict(about)}


def _position(point: Degrees) -> list[float]:
    """Return longitude and latitude, the order of GeoJSON."""
    return [round(point[1], DECIMALS), round(point[0], DECIMALS)]


NAMESPACE = "http://www.opengis.net/kml/2.2"
ELLIPSE_LINE = "ff00a5ff"
"""Colours are aabbggrr in KML: orange."""
ELLIPSE_FILL = "4000a5ff"


def kml(handoffs: Iterable[Handoff]) -> str:
    """Return a document with a placemark per position and one per ellipse."""
    root = ET.Element("kml", xmlns=NAMESPACE)
    document = ET.SubElement(root, "Document")
    add_text(document, "name", "Emitters")
    style = ET.SubElement(document, "Style", id="ellipse")
    add_text(ET.SubElement(style, "LineStyle"), "color", ELLIPSE_LINE)
    add_text(ET.SubElement(style, "PolyStyle"), "color", ELLIPSE_FILL)
    for handoff in handoffs:
        _add_placemarks(document, handoff)
    return xml_text(root)


def _add_placemarks(document: ET.Element, handoff: Handoff) -> None:
    about = (
        f"{handoff.state}, {handoff.radii}, {handoff.measurements} measurements, {handoff.time_utc}"
    )

    def placemark(suffix: str) -> ET.Element:
        element = ET.SubElement(document, "Placemark")
        add_text(element, "name", f"emitter {printable(handoff.emitter)}{suffix}")
        add_text(element, "description", about)
        return element

    points = {"": handoff.position_deg, ", second position": handoff.alternative_deg}
    for suffix, position_deg in points.items():
        if position_deg is not None:
            point = ET.SubElement(placemark(suffix), "Point")
            add_text(point, "coordinates", _coordinates(position_deg))
    ellipse = placemark(", 95 %")
    add_text(ellipse, "styleUrl", "#ellipse")
    boundary = ET.SubElement(ET.SubElement(ellipse, "Polygon"), "outerBoundaryIs")
    ring = (*handoff.ellipse_deg, handoff.ellipse_deg[0])
    text = " ".join(map(_coordinates, ring))
    add_text(ET.SubElement(boundary, "LinearRing"), "coordinates", text)


def add_text(parent: ET.Element, tag: str, text: str) -> None:
    """Add an element that contains a text."""
    ET.SubElement(parent, tag).text = text


def xml_text(root: ET.Element) -> str:
    """Return a document with indented lines."""
    ET.indent(root)
    return ET.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _coordinates(position_deg: Degrees) -> str:
    """Return longitude, latitude; without an altitude a viewer lays it on the ground."""
    return f"{position_deg[1]:.7f},{position_deg[0]:.7f}"


def printable(text: str) -> str:
    """Return `text` without characters that XML 1.0 cannot hold: control characters, surrogates."""
    return "".join(c if c.isprintable() else "?" for c in text)


COT_TYPE = "a-u-G"
"""Atom, unknown affiliation, ground: nothing is claimed about the owner of the radio."""
COT_HOW = "m-r"
STALE_AFTER_S = 600.0
COT_UNKNOWN = "9999999.0"
"""The schema's value for a height or a linear error that is unknown."""


def cot_event(handoff: Handoff, sender: str) -> bytes:
    """Return one event; an emitter keeps its `uid`, so that a sender's next event moves the marker.

    Source: MITRE, "Cursor on Target Message Router User's Guide", event schema 2.0; `ce` is the 95
    % circular error as TAK reads it, and absolute: the teams have their own receivers.
    """
    emitter = printable(handoff.emitter)
    event = ET.Element(
        "event",
        version="2.0",
        uid=f"{printable(sender)}.emitter.{emitter}",
        type=COT_TYPE,
        how=COT_HOW,
        time=handoff.time_utc,
        start=handoff.time_utc,
        stale=utc_text(handoff.unix_s + STALE_AFTER_S),
    )
    ET.SubElement(
        event,
        "point",
        lat=f"{handoff.position_deg[0]:.7f}",
        lon=f"{handoff.position_deg[1]:.7f}",
        hae=COT_UNKNOWN,  # the altitude is above sea level, not above the ellipsoid
        ce=f"{handoff.absolute_r95_m:.1f}",
        le=COT_UNKNOWN,
    )
    detail = ET.SubElement(event, "detail")
    ET.SubElement(detail, "contact", callsign=f"EMITTER {emitter}")
    remarks = f"{handoff.state}, {handoff.radii}, {handoff.measurements} measurements"
    ET.SubElement(detail, "remarks").text = remarks
    data: bytes = ET.tostring(event, encoding="utf-8", xml_declaration=True)
    return data


GEOJSON, KML, TEXT = "handoff.geojson", "handoff.kml", "handoff.txt"


class HandoffFiles:
    """Keeps the newest hand-off of every emitter."""

    def __init__(self) -> None:
        self._handoffs: dict[str, Handoff] = {}

    def files(self, report: ReportResult, unix_s: float) -> dict[str, str]:
        """Return the files' contents after a report, by name; none without an origin."""
        if report.origin is None:
            return {}
        emitter = "unknown" if report.emitter_id is None else str(report.emitter_id)
        self._handoffs[emitter] = handoff_of(emitter, report.estimate, report.origin, unix_s)
        handoffs = list(self._handoffs.values())
        return {
            GEOJSON: geojson(handoffs),
            KML: kml(handoffs),
            TEXT: "".join(_line(handoff) for handoff in handoffs),
        }


def _line(handoff: Handoff) -> str:
    """Return one emitter in one line, to be read out over the radio."""
    grid = mgrs_text(handoff.position_deg, handoff.absolute_r95_m)
    return (
        f"emitter {handoff.emitter}: {grid}  ({degrees_text(handoff.position_deg)}), "
        f"{handoff.radii}, {handoff.state}, {handoff.time_utc}\n"
    )
