"""The hand-off's value: degrees, heights and times of an estimate."""

import pytest

from tests.unit.companion.handoff.handoff_helpers import ORIGIN, POSITION_ENU_M, handoff


def test_the_place_is_the_estimate_in_degrees() -> None:
    east, north, _ = ORIGIN.enu_from_geodetic(*handoff().position_deg, handoff().altitude_m)
    assert (east, north) == pytest.approx(POSITION_ENU_M, abs=1e-6)
    assert handoff().altitude_m == ORIGIN.altitude_m


def test_only_an_ambiguous_estimate_has_a_second_place() -> None:
    assert handoff().alternative_deg is None
    ambiguous = handoff(alternative_enu_m=(30.0, 40.0))
    assert ambiguous.alternative_deg is not None
    assert ambiguous.state == "ambiguous"


def test_the_time_is_utc() -> None:
    assert handoff().time_utc == "2027-01-15T08:00:00Z"
