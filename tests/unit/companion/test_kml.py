"""KML that a standard parser reads, whatever an emitter is called."""

from xml.etree import ElementTree as ET

import pytest

from companion.handoff import NAMESPACE, kml
from tests.unit.companion.handoff.handoff_helpers import HOSTILE, handoff

KML = f"{{{NAMESPACE}}}"


def test_the_point_is_the_place_longitude_first() -> None:
    root = ET.fromstring(kml([handoff()]))
    coordinates = root.findtext(f".//{KML}Point/{KML}coordinates")
    assert coordinates is not None
    latitude, longitude = handoff().position_deg
    assert [float(v) for v in coordinates.split(",")] == pytest.approx([longitude, latitude])


def test_the_ellipse_is_closed() -> None:
    root = ET.fromstring(kml([handoff()]))
    ring = (root.findtext(f".//{KML}LinearRing/{KML}coordinates") or "").split()
    assert len(ring) > 12
    assert ring[0] == ring[-1]


def test_a_second_place_has_its_own_mark() -> None:
    root = ET.fromstring(kml([handoff(alternative_enu_m=(30.0, 40.0))]))
    names = [name.text for name in root.findall(f".//{KML}Placemark/{KML}name")]
    assert names == ["emitter 7", "emitter 7, second position", "emitter 7, 95 %"]


def test_a_hostile_name_is_escaped_and_its_control_characters_are_gone() -> None:
    text = kml([handoff(HOSTILE)])
    assert "<b>" not in text
    assert ET.fromstring(text).findtext(f".//{KML}Placemark/{KML}name") == 'emitter 7<b>&"?[31m?'


def test_the_description_says_for_whom_which_radius_is() -> None:
    about = ET.fromstring(kml([handoff()])).findtext(f".//{KML}Placemark/{KML}description")
    assert about is not None
    words = "R95 9.0 m absolute, 5.2 m relative (GNSS 3.00 m, assumed)"
    assert words in about
