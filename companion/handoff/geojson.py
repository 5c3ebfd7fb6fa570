"""GeoJSON (RFC 7946): the place, its 95 % ellipse and the second place."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping

from companion.handoff.record import Degrees, Handoff

DECIMALS = 7
"""About a centimetre; RFC 7946 section 11.2 asks not to write more than is known."""


def geojson(handoffs: Iterable[Handoff]) -> str:
    """A feature collection with up to three features per emitter."""
    features = [feature for handoff in handoffs for feature in _features(handoff)]
    return json.dumps({"type": "FeatureCollection", "features": features}, indent=2) + "\n"


def _features(handoff: Handoff) -> list[dict[str, object]]:
    about = {
        "emitter": handoff.emitter,
        "state": handoff.state,
        "r95_m": round(handoff.r95_m, 2),
        "altitude_amsl_m": round(handoff.altitude_m, 2),  # a third coordinate would be ellipsoidal
        "measurements": handoff.measurements,
        "time": handoff.time_utc,
    }
    # A ring is closed, and its inside lies to the left (RFC 7946 section 3.1.6).
    ring = [_position(point) for point in (*handoff.ellipse_deg, handoff.ellipse_deg[0])]
    features = [
        _feature(
            {"type": "Point", "coordinates": _position(handoff.place_deg)},
            {**about, "kind": "estimate"},
        ),
        _feature({"type": "Polygon", "coordinates": [ring]}, {**about, "kind": "ellipse_95"}),
    ]
    if handoff.alternative_deg is not None:
        other = {"type": "Point", "coordinates": _position(handoff.alternative_deg)}
        features.append(_feature(other, {**about, "kind": "alternative"}))
    return features


def _feature(geometry: Mapping[str, object], properties: Mapping[str, object]) -> dict[str, object]:
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _position(point: Degrees) -> list[float]:
    """Longitude first, as GeoJSON wants it."""
    return [round(point[1], DECIMALS), round(point[0], DECIMALS)]
