"""Cursor on Target: one marker per emitter, with its circular error."""

from xml.etree import ElementTree as ET

import pytest

from companion.handoff import cot_event
from tests.unit.companion.handoff.handoff_helpers import HOSTILE, handoff


def test_the_event_tells_place_error_and_when_it_is_stale() -> None:
    event = ET.fromstring(cot_event(handoff(r95_m=5.2), "companion-1"))
    point = event.find("point")
    assert point is not None
    latitude, longitude = handoff().position_deg
    assert float(point.attrib["lat"]) == pytest.approx(latitude, abs=1e-7)
    assert float(point.attrib["lon"]) == pytest.approx(longitude, abs=1e-7)
    assert point.attrib["ce"] == "9.0"  # 5.2 of the vehicle, and the 3 m that count for its own
    remarks = event.findtext("detail/remarks") or ""
    assert "m absolute, 5.2 m relative (GNSS 3.00 m, assumed)" in remarks
    assert event.attrib["start"] == "2027-01-15T08:00:00Z"
    assert event.attrib["stale"] == "2027-01-15T08:10:00Z"


def test_a_marker_moves_instead_of_multiplying() -> None:
    uids = {
        ET.fromstring(cot_event(handoff(name, r95_m=r95), sender)).attrib["uid"]
        for name, r95, sender in [
            ("7", 5.0, "a"),
            ("7", 1.0, "a"),
            ("8", 5.0, "a"),
            ("7", 5.0, "b"),
        ]
    }
    assert uids == {"a.emitter.7", "a.emitter.8", "b.emitter.7"}


def test_a_hostile_name_cannot_add_elements() -> None:
    event = ET.fromstring(cot_event(handoff(HOSTILE), HOSTILE))
    assert [child.tag for child in event] == ["point", "detail"]
    contact = event.find("detail/contact")
    assert contact is not None
    assert contact.attrib["callsign"] == 'EMITTER 7<b>&"?[31m?'
