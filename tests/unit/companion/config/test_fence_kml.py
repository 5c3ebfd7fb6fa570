from __future__ import annotations

import pytest

from companion.config.area_files import areas_of_kml
from companion.geometry.geofence import GeoArea, NamedArea

RING = "8.0,47.0,0 8.01,47.0,0\n 8.0,47.01 8.0,47.0,0"
CORNERS_DEG = ((47.0, 8.0), (47.0, 8.01), (47.01, 8.0))
FENCE = NamedArea("Polygon 1", True, GeoArea(CORNERS_DEG))


def boundary(kind: str, ring: str = RING) -> str:
    inside = f"<LinearRing><coordinates>{ring}</coordinates></LinearRing>"
    return f"<{kind}BoundaryIs>{inside}</{kind}BoundaryIs>"


def placemark(*boundaries: str, name: str = "search area") -> str:
    return f"<Placemark><name>{name}</name><Polygon>{''.join(boundaries)}</Polygon></Placemark>"


def kml(*parts: str, namespace: str = ' xmlns="http://www.opengis.net/kml/2.2"') -> str:
    head = '<?xml version="1.0" encoding="UTF-8"?>'
    return f"{head}<kml{namespace}><Document>{''.join(parts)}</Document></kml>"


@pytest.mark.parametrize("namespace", ["", ' xmlns="http://www.opengis.net/kml/2.2"'])
def test_a_polygon_is_the_fence(namespace: str) -> None:
    assert areas_of_kml(kml(placemark(boundary("outer")), namespace=namespace)) == [FENCE]


def test_a_ring_that_is_not_closed_is_one_all_the_same() -> None:
    open_ring = " ".join(RING.split()[:-1])
    assert areas_of_kml(kml(placemark(boundary("outer", open_ring)))) == [FENCE]


def test_holes_are_keep_outs() -> None:
    text = kml(placemark(boundary("outer"), boundary("inner"), boundary("inner")))
    assert areas_of_kml(text)[1:] == [
        NamedArea("Polygon 1, hole 1", False, GeoArea(CORNERS_DEG)),
        NamedArea("Polygon 1, hole 2", False, GeoArea(CORNERS_DEG)),
    ]


@pytest.mark.parametrize("name", ["keep-out house", "Exclusion 3", "NO-FLY", " keep out"])
def test_a_name_makes_a_keep_out(name: str) -> None:
    text = kml(placemark(boundary("outer")), placemark(boundary("outer"), name=name))
    areas = areas_of_kml(text)
    assert [(area.path, area.is_inclusion) for area in areas] == [
        ("Polygon 1", True),
        ("Polygon 2", False),
    ]


def test_a_folders_name_makes_keep_outs_of_all_in_it() -> None:
    houses = placemark(boundary("outer"), name="house") + placemark(boundary("outer"), name="hut")
    folder = f"<Folder><name>keep-out</name>{houses}</Folder>"
    areas = areas_of_kml(kml(folder, placemark(boundary("outer"))))
    assert [area.is_inclusion for area in areas] == [False, False, True]


def test_a_hole_in_a_keep_out_is_no_place_to_fly_to() -> None:
    text = kml(placemark(boundary("outer"), boundary("inner"), name="keep-out yard"))
    assert [area.path for area in areas_of_kml(text)] == ["Polygon 1"]


def test_points_and_paths_are_passed_over() -> None:
    point = "<Placemark><Point><coordinates>8,47</coordinates></Point></Placemark>"
    assert areas_of_kml(kml(point)) == []


BOMB = '<!DOCTYPE l [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;&a;">]><kml>&b;</kml>'


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", r"^line 1, column 1: not XML"),
        ("<kml><Document></kml>", r"^line 1, column \d+: not XML"),
        ("<gpx/>", "^<gpx>: is not KML"),
        (BOMB, "DOCTYPE"),
        (BOMB.replace("DOCTYPE", "doctype"), "DOCTYPE"),
        ("<kml>&lol;</kml>", "not XML"),
        (kml(placemark()), "^Polygon 1: has 0 outer rings"),
        (kml(placemark(boundary("outer") * 2)), "^Polygon 1: has 2 outer rings"),
        (kml(placemark(boundary("outer", "8,47 8"))), "^Polygon 1: corner 2: `8` is not"),
        (kml(placemark(boundary("outer", "8,x"))), "^Polygon 1: corner 1: `8,x` is not"),
        (kml(placemark(boundary("outer", "8,47,0,5"))), "corner 1: `8,47,0,5` is not"),
        (kml(placemark(boundary("outer", "nan,47"))), "corner 1: `nan,47` is not"),
        (kml(placemark(boundary("outer", "8,inf"))), "corner 1: `8,inf` is not"),
        (
            kml(placemark(boundary("outer"), boundary("inner", "8,y"))),
            "^Polygon 1, hole 1: corner 1: `8,y` is not",
        ),
    ],
)
def test_what_is_no_kml_is_refused_with_its_place(text: str, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        areas_of_kml(text)


def test_an_empty_ring_has_no_corners() -> None:
    assert areas_of_kml(kml(placemark(boundary("outer", ""))))[0].area == GeoArea(())


def test_depth_is_no_problem() -> None:
    nested = "<Folder>" * 5_000 + placemark(boundary("outer")) + "</Folder>" * 5_000
    assert areas_of_kml(kml(nested)) == [FENCE]
