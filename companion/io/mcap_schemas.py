"""The channels of our MCAP files and the schemas of their messages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

FRAME_CHANNEL, INPUT_CHANNEL = "/mavlink", "/companion/inputs"

_NUMBER = {"type": "number"}
_TEXT = {"type": "string"}
_TIME = {
    "type": "object",
    "title": "time",
    "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
}


def _object(**properties: object) -> dict[str, object]:
    return {"type": "object", "properties": properties}


_POSE = _object(
    timestamp=_TIME,
    frame_id=_TEXT,
    pose=_object(
        position=_object(x=_NUMBER, y=_NUMBER, z=_NUMBER),
        orientation=_object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER),
    ),
)
_FIX = _object(
    timestamp=_TIME,
    frame_id=_TEXT,
    latitude=_NUMBER,
    longitude=_NUMBER,
    altitude=_NUMBER,
    position_covariance={"type": "array", "items": _NUMBER},
    position_covariance_type={"type": "integer"},
)
_LOG = _object(
    timestamp=_TIME,
    level={"type": "integer"},
    message=_TEXT,
    name=_TEXT,
    file=_TEXT,
    line={"type": "integer"},
)
_RESIDUAL = _object(
    nis=_NUMBER,
    range_innovation=_NUMBER,
    range_weight=_NUMBER,
    bearing_innovation=_NUMBER,
    bearing_weight=_NUMBER,
)
_EVENT = _object(t_s=_NUMBER, kind=_TEXT)


@dataclass(frozen=True, slots=True)
class Channel:
    """A topic and how its messages are read."""

    topic: str
    schema_name: str = ""
    schema: Mapping[str, object] | None = None
    """None: the messages are bytes without a schema."""
    message_encoding: str = "json"
    schema_encoding: str = "jsonschema"


CHANNELS = (
    Channel("/estimate/fix", "foxglove.LocationFix", _FIX),
    Channel("/estimate/ellipse", "foxglove.GeoJSON", _object(geojson=_TEXT)),
    Channel("/estimate/pose", "foxglove.PoseInFrame", _POSE),
    Channel("/vehicle/pose", "foxglove.PoseInFrame", _POSE),
    Channel("/residual", "companion.Residual", _RESIDUAL),
    Channel("/log", "foxglove.Log", _LOG),
    Channel("/events", "companion.Event", _EVENT),
    Channel(FRAME_CHANNEL, message_encoding="mavlink"),
    Channel(INPUT_CHANNEL, message_encoding="companion-inputs"),
)
