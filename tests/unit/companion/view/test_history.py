"""The map's track and curves: bounded, true in shape, and whole for every reader."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest

from companion.geometry.polygons import Point
from companion.view.history import (
    CURVE_POINTS,
    MAX_CORNERS,
    TOLERANCE_M,
    CurveHistory,
    FlightTrack,
    History,
    HistoryPart,
    HistoryReader,
)


def off_line_m(position: Point, line: list[Point]) -> float:
    """Return the distance from a position to the nearest part of a line."""
    return min(off_leg_m(position, *leg) for leg in pairwise(line))


def off_leg_m(position: Point, start: Point, end: Point) -> float:
    (px, py), (sx, sy), (ex, ey) = position, start, end
    length2 = (ex - sx) ** 2 + (ey - sy) ** 2
    share = 0.0 if length2 == 0.0 else ((px - sx) * (ex - sx) + (py - sy) * (ey - sy)) / length2
    share = min(1.0, max(0.0, share))
    return math.dist(position, (sx + share * (ex - sx), sy + share * (ey - sy)))


def crossings(count: int) -> list[Point]:
    """Return straight passes over a position, with a half turn behind it, 0.5 m apart."""
    positions: list[Point] = []
    for number in range(count):
        turn_rad = number * math.radians(40.0)
        c, s = math.cos(turn_rad), math.sin(turn_rad)
        away = [(-20.0 + 0.5 * step, 0.0) for step in range(80)]
        round_it = [
            (20.0 + 4.0 * math.sin(a), 4.0 - 4.0 * math.cos(a))
            for a in (0.125 * step for step in range(25))
        ]
        positions += [(c * x - s * y, s * x + c * y) for x, y in (*away, *round_it)]
    return positions


def test_no_position_is_farther_from_the_line_than_the_tolerance() -> None:
    track, positions = FlightTrack(), crossings(6)
    for position in positions:
        track.add(position)
    assert max(off_line_m(position, track.line) for position in positions) <= TOLERANCE_M + 1e-9
    assert len(track.items) < len(positions) / 4
    assert track.line[0] == positions[0]
    assert track.line[-1] == pytest.approx(positions[-1], abs=TOLERANCE_M)


def test_a_hover_leaves_one_corner_and_a_way_back_its_turn() -> None:
    track = FlightTrack()
    for step in range(100):
        track.add((0.002 * step, 0.0))
    assert track.line == [(0.0, 0.0)]
    for east_m in (10.0, 20.0, 30.0, 20.0, 10.0):
        track.add((east_m, 0.0))
    assert track.line == [(0.0, 0.0), (30.0, 0.0), (10.0, 0.0)]


def test_a_flight_of_hours_keeps_its_beginning_as_well_as_its_end() -> None:
    track, positions = FlightTrack(), crossings(400)
    for number, (east_m, north_m) in enumerate(positions):
        track.add((east_m + 0.02 * number, north_m))
    assert len(track.items) <= MAX_CORNERS
    first = [(east_m + 0.02 * n, north_m) for n, (east_m, north_m) in enumerate(positions[:400])]
    assert max(off_line_m(position, track.line[:400]) for position in first) < 4.0


def test_another_origin_begins_another_track() -> None:
    track = FlightTrack()
    for position in ((0.0, 0.0), (9.0, 0.0)):
        track.add(position)
    version = track.version
    track.clear()
    track.add((3.0, 3.0))
    assert track.line == [(3.0, 3.0)]
    assert track.version != version


def test_curves_of_a_long_flight_are_evenly_thinned() -> None:
    curve = CurveHistory()
    for tick in range(40 * CURVE_POINTS):
        if curve.is_due(0.5 * tick):
            curve.add({"t_s": 0.5 * tick}, 0.5 * tick)
    times_s = [float(str(point["t_s"])) for point in curve.items]
    steps_s = {after - before for before, after in pairwise(times_s)}
    assert len(curve.items) <= CURVE_POINTS
    assert times_s[0] == 0.0
    assert max(steps_s) <= 2.0 * min(steps_s)


def test_every_reader_gets_the_whole_however_late_it_comes() -> None:
    track, early = FlightTrack(), HistoryReader()
    mirrors: dict[HistoryReader, History[Point]] = {early: History()}
    sent = 0
    for number, (east_m, north_m) in enumerate(crossings(200)):
        track.add((east_m + 0.1 * number, north_m))
        if number == 5000:
            mirrors[HistoryReader()] = History()
        if number % 7:
            continue  # a snapshot that was dropped
        for reader, mirror in mirrors.items():
            part = reader.next_part(track)
            mirror.take(part)
            sent += len(part.items)
            assert mirror.items == track.items
    assert len(mirrors) == 2
    assert sent < 20 * MAX_CORNERS


def test_a_part_that_was_lost_is_made_good() -> None:
    history: History[int] = History()
    reader = HistoryReader(whole_every=40)
    wholes = []
    for number in range(120):
        history.take(HistoryPart([number], is_whole=False))
        wholes.append(reader.next_part(history).is_whole)
    assert [number for number, is_whole in enumerate(wholes) if is_whole] == [0, 40, 80]
