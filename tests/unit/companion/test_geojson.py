"""GeoJSON as RFC 7946 wants it."""

import itertools
import json
from typing import Any

import pytest

from companion.handoff import geojson
from tests.unit.companion.handoff.handoff_helpers import HOSTILE, handoff


def features(text: str) -> list[dict[str, Any]]:
    value = json.loads(text)
    assert value["type"] == "FeatureCollection"
    found: list[dict[str, Any]] = value["features"]
    return found


def test_longitude_comes_first() -> None:
    point = features(geojson([handoff()]))[0]["geometry"]
    assert point["type"] == "Point"
    latitude, longitude = handoff().place_deg
    assert point["coordinates"] == pytest.approx([longitude, latitude], abs=1e-7)


def test_the_ellipse_is_a_closed_ring_that_turns_left() -> None:
    (ring,) = features(geojson([handoff()]))[1]["geometry"]["coordinates"]
    assert ring[0] == ring[-1]
    turns = sum(a[0] * b[1] - b[0] * a[1] for a, b in itertools.pairwise(ring))
    assert turns > 0.0


def test_every_emitter_has_its_features_and_the_ambiguous_one_more() -> None:
    both = [handoff("1"), handoff("2", alternative_enu_m=(30.0, 40.0))]
    kinds = [(f["properties"]["emitter"], f["properties"]["kind"]) for f in features(geojson(both))]
    assert kinds == [
        ("1", "estimate"),
        ("1", "ellipse_95"),
        ("2", "estimate"),
        ("2", "ellipse_95"),
        ("2", "alternative"),
    ]


def test_a_hostile_name_stays_a_name() -> None:
    assert features(geojson([handoff(HOSTILE)]))[0]["properties"]["emitter"] == HOSTILE
