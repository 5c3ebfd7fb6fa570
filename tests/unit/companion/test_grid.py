"""MGRS, against positions whose squares follow from the definition."""

import pytest

from companion.handoff import mgrs_text, minutes_text


def test_the_square_of_the_zero_point() -> None:
    # Zone 31 begins at 0 degrees; the UTM easting of the equator there is 166021.4 m.
    assert mgrs_text((0.0, 0.0), 1.0) == "31N AA 66021 00000"


def test_a_zone_of_one_figure_has_no_leading_zero() -> None:
    assert mgrs_text((21.30943, -157.91687), 1.0).startswith("4Q FJ ")


@pytest.mark.parametrize(
    ("r95_m", "digits"),
    [(0.05, 5), (1.0, 5), (9.9, 5), (10.0, 4), (99.0, 4), (150.0, 3), (5e3, 2), (1e7, 1)],
)
def test_the_square_is_no_finer_than_the_place_is_known(r95_m: float, digits: int) -> None:
    _, _, east, north = mgrs_text((47.4, 8.54), r95_m).split()
    assert len(east) == len(north) == digits


def test_the_poles_and_the_southern_half_have_squares() -> None:
    assert mgrs_text((89.5, 10.0), 1.0).startswith("Z ")
    assert mgrs_text((-33.8688, 151.2093), 1.0).startswith("56H LH ")


@pytest.mark.parametrize(
    ("position", "text"),
    [
        ((47.398012, 8.546123), "47° 23.881' N, 8° 32.767' E"),
        ((-0.5, -70.999_999_9), "0° 30.000' S, 71° 00.000' W"),
        ((12.016_666, 0.0), "12° 01.000' N, 0° 00.000' E"),
    ],
)
def test_degrees_and_minutes_carry_over(position: tuple[float, float], text: str) -> None:
    assert minutes_text(position) == text
