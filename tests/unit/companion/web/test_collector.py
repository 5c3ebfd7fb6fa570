"""The past on the map is bounded, and sent once."""

from companion.guidance.commands import Severity
from companion.web.live_map import MARKS, TEXTS, Collector


def estimate(t_s: float) -> dict[str, object]:
    return {
        "sensor_enu_m": (t_s, 0.0, 20.0),
        "range_m": 30.0,
        "bearing_enu_rad": None,
        "range_weight": 0.5,
        "r95_m": 4.0,
        "range_offset_m": 0.1,
        "range_innovation": 2.0,
        "nis": 1.5,
    }


def test_lists_keep_the_newest() -> None:
    collector = Collector()
    for t in range(2000):
        collector.record("estimate", estimate(float(t)), float(t))
        collector.text(Severity.INFO, f"text {t}", float(t))
    assert len(collector.marks) == MARKS
    assert len(collector.texts) == TEXTS
    assert collector.texts[-1] == (1999.0, "info", "text 1999")
    assert collector.marks[-1]["t_s"] == 1999.0


def test_the_curve_is_sent_once_and_has_at_most_two_points_a_second() -> None:
    collector = Collector()
    for tick in range(100):
        collector.record("estimate", estimate(0.1 * tick), 0.1 * tick)
    points, _ = collector.next_parts(1)["curve"]
    assert 18 <= len(points) <= 21
    assert points[0]["range_innovation"] == 2.0
    assert collector.next_parts(1)["curve"].items == []


def test_the_track_is_of_the_log_and_of_one_frame() -> None:
    collector = Collector()
    for east_m in range(5):
        collector.record("position", {"position_enu_m": (float(east_m), 0.0, 20.0)}, 1.0)
    collector.record("position", {"position_enu_m": (4.0, 9.0, 20.0)}, 2.0)
    assert collector.next_parts(1)["track"].items == [(0.0, 0.0), (4.0, 0.0)]
    origin = {"latitude_deg": 47.0, "longitude_deg": 8.0, "altitude_m": 488.0}
    collector.record("origin", origin, 3.0)
    assert collector.next_parts(1)["track"] == ([], True)
    collector.record("position", {"position_enu_m": (1.0, 1.0, 20.0)}, 4.0)
    collector.record("origin", {**origin, "altitude_m": 489.0}, 5.0)
    assert collector.next_parts(1)["track"] == ([(1.0, 1.0)], False)


def test_other_records_are_not_shown_and_an_estimate_without_a_place_has_no_mark() -> None:
    collector = Collector()
    collector.record("link", {"setpoints": 3}, 1.0)
    collector.record("estimate", {"r95_m": 4.0}, 2.0)
    assert not collector.marks
    assert len(collector.next_parts(1)["curve"].items) == 1
