"""GeoJSON as RFC 7946 requires."""

import itertools
import json
from typing import Any

import pytest

from companion.domain import PositionAccuracy
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
    latitude, longitude = handoff().position_deg
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


def test_both_radii_are_reported_and_whose_error_is_in_them() -> None:
    own = PositionAccuracy(1.5, 2.0, is_reported=True)
    point, ellipse = features(geojson([handoff(own=own, height_sigma_m=1.5)]))
    about = point["properties"]
    assert about["r95_m"] == 5.2
    assert about["absolute_r95_m"] == pytest.approx(7.57, abs=0.01)
    assert (about["own_sigma_m"], about["own_sigma_told"]) == (1.5, True)
    assert about["altitude_sigma_m"] == 2.5
    assert "altitude_sigma_m" not in features(geojson([handoff()]))[0]["properties"]
    (ring,) = ellipse["geometry"]["coordinates"]
    half_m = 0.5 * 111_180 * (max(p[1] for p in ring) - min(p[1] for p in ring))
    assert half_m == pytest.approx(2.4477 * (2.0 + (1.5 * 1.5) ** 2) ** 0.5, rel=0.02)
