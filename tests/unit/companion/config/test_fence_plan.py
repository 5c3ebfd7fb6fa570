from __future__ import annotations

import json
from typing import Any

import pytest

from companion.config.area_files import areas_of_plan
from companion.geometry.geofence import GeoArea, NamedArea

TRIANGLE = [[47.0, 8.0], [47.0, 8.01], [47.01, 8.0]]


def plan(**fence: Any) -> dict[str, Any]:
    """A plan as QGroundControl saves one, with these parts of the fence."""
    empty = {"circles": [], "polygons": [], "version": 2}
    return {
        "fileType": "Plan",
        "geoFence": empty | fence,
        "groundStation": "QGroundControl",
        "mission": {"items": [], "version": 2},
        "rallyPoints": {"points": [], "version": 2},
        "version": 1,
    }


def polygon(corners: Any = TRIANGLE, inclusion: Any = True, version: Any = 1) -> dict[str, Any]:
    return {"inclusion": inclusion, "polygon": corners, "version": version}


def circle(center: Any = (47.0, 8.0), radius: Any = 50.0) -> dict[str, Any]:
    return {"circle": {"center": center, "radius": radius}, "inclusion": False, "version": 1}


def test_polygons_and_circles_are_read_in_order() -> None:
    text = json.dumps(plan(polygons=[polygon(), polygon(inclusion=False)], circles=[circle()]))
    corners = tuple((lat, lon) for lat, lon in TRIANGLE)
    assert areas_of_plan(text) == [
        NamedArea("geoFence.polygons[0]", True, GeoArea(corners)),
        NamedArea("geoFence.polygons[1]", False, GeoArea(corners)),
        NamedArea("geoFence.circles[0]", False, GeoArea(((47.0, 8.0),), 50.0)),
    ]


def test_a_plan_without_areas_has_none() -> None:
    fence = plan()
    assert areas_of_plan(json.dumps(fence)) == []
    del fence["geoFence"]["circles"]
    assert areas_of_plan(json.dumps(fence)) == []


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "line 1, column 1"),
        ("{,}", "line 1, column 2"),
        ("[" * 100_000, "nested too deeply"),
        ("[]", "fileType"),
        ('{"fileType": "Parameters"}', "fileType"),
        ('{"fileType": "Plan", "fileType": "Plan"}', "the key `fileType` is given twice"),
        ('{"fileType": "Plan"}', "geoFence: is missing"),
        ('{"fileType": "Plan", "geoFence": []}', "geoFence: is missing"),
    ],
)
def test_what_is_no_plan_is_refused(text: str, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        areas_of_plan(text)


@pytest.mark.parametrize(
    ("fence", "problem"),
    [
        ({"version": 1}, r"^geoFence\.version: is 1, not 2"),
        ({"version": 3}, r"^geoFence\.version: is 3, not 2"),
        ({"version": "2"}, r'^geoFence\.version: is "2", not 2'),
        ({"version": True}, r"^geoFence\.version: is true, not 2"),
        ({"polygons": {}}, r"^geoFence\.polygons: is not a list"),
        ({"circles": 1}, r"^geoFence\.circles: is not a list"),
        ({"polygons": [5]}, r"^geoFence\.polygons\[0\]: is not an object"),
        ({"polygons": [{}]}, r"^geoFence\.polygons\[0\]\.version: is null, not 1"),
        ({"polygons": [polygon(version=True)]}, r"polygons\[0\]\.version: is true, not 1"),
        ({"polygons": [polygon(), polygon(version=2)]}, r"polygons\[1\]\.version: is 2, not 1"),
        ({"polygons": [polygon(inclusion=None)]}, r"\[0\]\.inclusion: is not true or false"),
        ({"polygons": [polygon(inclusion=1)]}, r"\[0\]\.inclusion: is not true or false"),
        ({"polygons": [polygon(corners=None)]}, r"\[0\]\.polygon: is not a list of corners"),
        ({"polygons": [polygon([[47.0]])]}, r"polygon\[0\]: is not \[latitude, longitude\]"),
        ({"polygons": [polygon([[1, 2], 5])]}, r"polygon\[1\]: is not \[latitude, longitude\]"),
        ({"polygons": [polygon([["47", 8]])]}, r"polygon\[0\]\[0\]: is not a finite number"),
        ({"polygons": [polygon([[47, True]])]}, r"polygon\[0\]\[1\]: is not a finite number"),
        ({"polygons": [polygon([[47, float("nan")]])]}, r"\[1\]: is not a finite number"),
        ({"polygons": [polygon([[10**400, 8]])]}, r"polygon\[0\]\[0\]: is not a finite number"),
        ({"circles": [{"version": 1}]}, r"circles\[0\]\.circle: is missing"),
        ({"circles": [circle(center=None)]}, r"circle\.center: is not \[latitude, longitude\]"),
        ({"circles": [circle(radius=None)]}, r"circle\.radius: is not a finite number"),
        ({"circles": [circle(radius=float("inf"))]}, r"circle\.radius: is not a finite number"),
    ],
)
def test_a_wrong_element_is_named_by_its_path(fence: dict[str, Any], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        areas_of_plan(json.dumps(plan(**fence)))
