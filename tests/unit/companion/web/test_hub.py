"""What the page remembers is bounded, and starts anew with the flight."""

import math

from companion.web.server import CURVE_POINTS, TRACK_POINTS, PictureFeed

ORIGIN = [47.4, 8.5]


def picture(t_s: float, place: tuple[float, float], origin: object = ORIGIN) -> dict[str, object]:
    return {
        "t_s": t_s,
        "origin": origin,
        "vehicle": [*place, 20.0],
        "curve": [{"t_s": t_s, "r95_m": 1.0}],
    }


def test_a_hover_leaves_one_point() -> None:
    hub = PictureFeed({})
    for t_s in range(100):
        hub.take(picture(float(t_s), (0.001 * t_s, 0.0)))
    assert len(hub.track) == 1


def test_a_long_flight_is_thinned_and_keeps_its_shape() -> None:
    hub = PictureFeed({})
    for step in range(10 * TRACK_POINTS):
        hub.take(picture(float(step), (100.0 * math.cos(step / 50), 100.0 * math.sin(step / 50))))
    assert len(hub.track) <= TRACK_POINTS
    assert len(hub.curve) <= CURVE_POINTS
    assert hub.curve[0]["t_s"] < 1000.0
    assert max(east for east, _ in hub.track) > 95.0


def test_a_new_flight_and_a_new_origin_forget_the_track() -> None:
    hub = PictureFeed({})
    hub.take(picture(10.0, (0.0, 0.0)))
    hub.take(picture(11.0, (5.0, 0.0)))
    hub.take(picture(0.1, (9.0, 9.0)))
    assert hub.track == [(9.0, 9.0)]
    assert [point["t_s"] for point in hub.curve] == [0.1]
    hub.take(picture(1.0, (1.0, 1.0), origin=[0.0, 0.0]))
    assert hub.track == [(1.0, 1.0)]


def test_without_a_position_there_is_no_track() -> None:
    hub = PictureFeed({})
    hub.take({"t_s": 0.0, "origin": None, "vehicle": None})
    assert hub.track == []
    assert hub.version == 1
