"""The flight report: one page, whole in itself, true to the event log, and safe to open."""

from __future__ import annotations

import base64
import json
import math
import re
from functools import partial
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree as ET

import msgspec
import numpy as np
import pytest

from companion.cli import main
from companion.config.schema import CompanionConfig, LimitsConfig
from companion.errors import EXIT_BAD_INPUT, ConfigError
from companion.estimation.filters.kalman import asymmetric_huber_loss
from companion.flight_setup import FlightFacts, write_facts
from companion.geometry.coordinates import Projection, tile_at
from companion.guard.gate import GuardReason
from companion.guard.limits import Fence
from companion.guidance.messages import FenceMessages, GuardMessages
from companion.handoff import mgrs_text
from companion.io.files import EVENTS
from companion.report.charts import histogram
from companion.report.flight_summary import summarize_events
from companion.report.page import (
    huber_cumulative,
    is_quick,
    report_page,
    verdict_of,
    write_report,
)
from companion.web.settings import NO_TILE

FACTS = FlightFacts(started_unix_s=1.8e9, links=1, config=CompanionConfig())
Line = dict[str, object]


def estimate(t_s: float, r95_m: float = 4.0) -> Line:
    return {
        "t_s": t_s,
        "kind": "estimate",
        "state": "searching",
        "position_enu_m": [10.0, 20.0],
        "covariance_m2": [[4.0, 1.0], [1.0, 2.0]],
        "sensor_enu_m": [t_s, 5.0, 20.0],
        "r95_m": r95_m,
        "range_offset_m": 0.3,
        "range_innovation": 7.0,
        "range_weight": 0.2,
        "nis": 1.2,
    }


def text(t_s: float, words: str) -> Line:
    return {"t_s": t_s, "kind": "text", "severity": "info", "text": words}


RESULT: Line = {
    "t_s": 60.0,
    "kind": "result",
    "state": "localised",
    "r95_m": 0.4,
    "latitude_deg": 47.4,
    "longitude_deg": 8.5,
}
FLIGHT = [estimate(0.5 * n, 20.0 / (1 + n)) for n in range(40)] + [text(3.0, "flying"), RESULT]


class Tags(HTMLParser):
    """Elements of a page, and the resources that it loads."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []
        self.loads: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.names.append(tag)
        self.loads += [value or "" for name, value in attrs if name in ("src", "href")]


def page_of(lines: list[Line], limits: LimitsConfig | None = None) -> str:
    facts = FACTS
    if limits is not None:
        facts = msgspec.structs.replace(FACTS, config=CompanionConfig(limits=limits))
    return report_page(summarize_events(lines), facts, "2026-11-21T10-00-00Z")


def test_the_page_loads_nothing_and_runs_nothing() -> None:
    tags = Tags()
    tags.feed(page_of(FLIGHT))
    assert tags.loads == []
    assert "script" not in tags.names
    assert tags.names.count("svg") == 6


def test_every_drawing_is_well_formed() -> None:
    for svg in re.findall(r"<svg.*?</svg>", page_of(FLIGHT), flags=re.DOTALL):
        assert ET.fromstring(svg).tag == "svg"


def test_a_fence_that_the_configuration_does_not_know_is_not_drawn() -> None:
    assert '<polygon class="fence"' in page_of(FLIGHT)
    page = page_of(FLIGHT, LimitsConfig(autopilot_fence="use"))
    assert '<polygon class="fence"' not in page
    assert "dashed green" not in page


def test_ellipses_that_would_cover_the_map_are_left_out_and_newer_ones_are_stronger() -> None:
    page = page_of([estimate(float(n), 500.0 / (1 + n)) for n in range(60)])
    ellipses = re.findall('<polygon class="ellipse"( opacity="([0-9.]+)")?', page)
    strengths = [float(opacity or 1.0) for _, opacity in ellipses]
    assert 1 <= len(strengths) < 8
    assert strengths == sorted(strengths)
    assert strengths[-1] == 1.0


def test_counters_of_the_link_are_reported_as_text() -> None:
    link: Line = {"t_s": 1.0, "kind": "link", "lost": 3, "refused": {}, "new_one": {"late": 2}}
    page = page_of([*FLIGHT, link])
    rows = dict(re.findall("<div><dt>([^<]*)</dt><dd>([^<]*)</dd></div>", page))
    assert rows["frames lost"] == "3"
    assert rows["measurements rejected"] == "none"
    assert rows["new one"] == "late: 2"


def test_the_verdict_is_what_the_flight_came_to() -> None:
    assert verdict_of(summarize_events(FLIGHT)) == "localised, R95 0.40 m relative"
    assert (
        verdict_of(summarize_events(FLIGHT[:-1])) == "not reported: searching, R95 0.5 m relative"
    )
    assert verdict_of(summarize_events([])) == "no measurement was used"


@pytest.mark.parametrize(("is_reported", "words"), [(True, ""), (False, ", assumed")])
def test_both_radii_are_reported_where_the_log_has_both(is_reported: bool, words: str) -> None:
    own = {"absolute_r95_m": 3.7, "own_sigma_m": 1.5, "own_sigma_told": is_reported}
    lines = [{**estimate(1.0), **own}, {**RESULT, **own}]
    radii = f"R95 3.70 m absolute, 0.40 m relative (GNSS 1.50 m{words})"
    assert verdict_of(summarize_events(lines)) == f"localised, {radii}"
    page = page_of(lines)
    assert f"reported: localised, {radii}" in page
    assert page.count('<circle class="radius"') == page.count('<circle class="absolute"') == 1
    assert '<circle class="absolute"' not in page_of(FLIGHT)


def test_the_budget_of_r95_stands_beside_each_result() -> None:
    budget = {"thermal noise": 0.031, "rival places": 0.4}
    page = page_of([*FLIGHT[:-1], {**RESULT, "emitter_id": 7, "r95_budget_m": budget}])
    assert "Budget of R95 of emitter 7" in page
    assert '<td>thermal noise</td><td class="number">0.031</td>' in page
    assert "Budget of R95" not in page_of(FLIGHT)
    assert "Budget of R95" not in page_of([*FLIGHT[:-1], {**RESULT, "r95_budget_m": {}}])


ORIGIN: Line = {
    "t_s": 0.0,
    "kind": "origin",
    "latitude_deg": 47.4,
    "longitude_deg": 8.5,
    "altitude_m": 488.0,
    "projection": Projection.SPHERE.value,
    "offset_enu_m": [0.0, 0.0, 0.0],
    "scale_en": [1.0, 1.0],
}


def position(t_s: float, east_m: float, north_m: float) -> Line:
    return {"t_s": t_s, "kind": "position", "position_enu_m": [east_m, north_m, 20.0]}


def facts_in(page: str) -> dict[str, str]:
    """The figures below the heading."""
    return dict(re.findall("<div><dt>([^<]*)</dt><dd>([^<]*)</dd></div>", page))


def test_it_has_date_zone_and_the_place_as_degrees_and_grid() -> None:
    page = page_of([ORIGIN, *FLIGHT])
    figures = facts_in(page)
    assert figures["Begun"] == "2027-01-15 08:00:00 UTC"
    assert figures["Position"] == "47.4000000, 8.5000000"
    assert figures["Grid"] == mgrs_text((47.4, 8.5), 0.4)
    assert "<th>UTC</th>" in page
    assert "<td>08:00:03</td>" in page


def test_an_estimate_that_was_not_reported_has_its_place_on_the_earth_too() -> None:
    figures = facts_in(page_of([ORIGIN, estimate(1.0, 40.0)]))
    latitude_deg, longitude_deg = map(float, figures["Position"].split(", "))
    assert (latitude_deg, longitude_deg) == pytest.approx((47.40018, 8.50013), abs=2e-5)
    assert len(figures["Grid"].split()[-1]) == 4
    assert "Position" not in facts_in(page_of([estimate(1.0)]))


def test_a_flight_that_never_heard_anything_has_its_track() -> None:
    flown = [position(float(n), 2.0 * n, 30.0 if n > 5 else 0.0) for n in range(10)]
    page = page_of([*flown, {"t_s": 9.0, "kind": "link", "accepted": 0, "refused": {}}])
    assert "the emitter was never heard" in page
    track = re.search('<polyline class="track" points="([^"]+)"', page)
    assert track is not None
    assert len(track.group(1).split()) >= 4
    assert "red: 95 % ellipses" not in page
    assert "Position" not in facts_in(page)


def test_the_map_lies_on_the_tiles_that_there_are(tmp_path: Path) -> None:
    lines = [ORIGIN, *FLIGHT]
    summary = summarize_events(lines)
    x, y = tile_at((47.4, 8.5), 17)
    for number, column in enumerate((x, x + 1)):
        path = tmp_path / "17" / str(column) / f"{y}.png"
        path.parent.mkdir(parents=True)
        path.write_bytes(NO_TILE if number == 0 else b"no picture")
    page = report_page(summary, FACTS, "flight", tmp_path)
    pictures = re.findall(r'<image href="([^"]+)" x="([-\d.]+)" [^>]*width="([\d.]+)"', page)
    (url, left, width) = pictures[0]
    assert len(pictures) == 1
    assert base64.b64decode(url.removeprefix("data:image/png;base64,")) == NO_TILE
    tick = re.findall(r'd="M([\d.]+) [\d.]+V[\d.]+"/><text class="tick"[^>]*>(-?\d+)<', page)
    (first_px, first_m), (second_px, second_m) = tick[:2]
    scale = (float(second_px) - float(first_px)) / (float(second_m) - float(first_m))
    tile_m = 2.0 * math.pi * 6_371_000.0 * math.cos(math.radians(47.4)) / 2**17
    assert float(width) / scale == pytest.approx(tile_m, rel=3e-3)
    zero_px = float(first_px) - scale * float(first_m)
    assert float(left) <= zero_px <= float(left) + float(width)
    for svg in re.findall(r"<svg.*?</svg>", page, flags=re.DOTALL):
        ET.fromstring(svg)
    assert "<image" not in report_page(summarize_events(FLIGHT), FACTS, "flight", tmp_path)


def bars_of(svg: str) -> tuple[list[float], list[float]]:
    """Heights of the bars, and of the expected line in each, in pixels."""
    floor = 220.0 - 28.0
    bars = re.findall('<polygon class="bar" points="([^"]+)"', svg)
    heights = [floor - min(float(p.split(",")[1]) for p in bar.split()) for bar in bars]
    line = re.search('<polyline class="limit" points="([^"]+)"', svg)
    assert line is not None
    return heights, [floor - float(p.split(",")[1]) for p in line.group(1).split()[::2]]


@pytest.mark.parametrize("sigma_m", [1e-3, 0.3, 3.0])
def test_a_histogram_and_what_is_expected_of_it_have_one_scale(sigma_m: float) -> None:
    values = np.random.default_rng(1).normal(0.0, 0.3, 4000).tolist()
    expected = partial(huber_cumulative, sigma_m, math.inf, math.inf)
    chart = histogram("Residuals", "", [*values, 900.0, -50.0], expected)
    assert chart is not None
    bars, line = bars_of(str(chart.svg))
    assert sum(bars) == pytest.approx(sum(line), rel=0.02)
    assert sum(bar > 5.0 for bar in bars) > len(bars) / 3 or sigma_m < 0.1
    assert "the outermost bars include all beyond them (-50 to 900)" in chart.note


@pytest.mark.parametrize("thresholds", [(1.5, 0.4), (2.0, math.inf), (math.inf, math.inf)])
def test_what_the_loss_expects_is_its_own_integral(thresholds: tuple[float, float]) -> None:
    sigma, steps = 0.7, np.linspace(-40.0, 40.0, 160_001)
    heights = np.exp([-asymmetric_huber_loss(u, *thresholds) for u in steps])
    below = np.cumsum(heights) / heights.sum()
    expected = partial(huber_cumulative, sigma, *thresholds)
    for at in range(0, len(steps), 4001):
        assert expected(sigma * steps[at]) == pytest.approx(below[at], abs=1e-3)


def test_guard_interventions_are_counted() -> None:
    fence: Line = {"t_s": 1.0, "kind": "guard", "reasons": ["fence", "lagging"]}
    over: Line = {"t_s": 2.0, "kind": "guard", "reasons": []}
    summary = summarize_events([fence, over, fence, {**fence, "reasons": ["fence"]}, over])
    assert summary.guard.most_common(1) == [(GuardReason.FENCE.value, 3)]
    assert GuardReason.FENCE.value in page_of([fence])


def test_the_guards_own_records_are_understood() -> None:
    names = GuardMessages().record((GuardReason.TOO_FAST, GuardReason.CUT_OFF), 1.0)
    assert summarize_events([{"t_s": 1.0, "kind": "guard", "reasons": names}]).guard == {
        GuardReason.TOO_FAST.value: 1,
        GuardReason.CUT_OFF.value: 1,
    }


def test_the_fence_that_the_guard_kept_is_drawn_wherever_it_came_from() -> None:
    limits = LimitsConfig(autopilot_fence="use")
    kept = Fence(
        ((0.0, 0.0), (90.0, 0.0), (0.0, 90.0)), 3.0, (((20.0, 20.0), (25.0, 20.0), (20.0, 25.0)),)
    )
    record = json.loads(json.dumps(FenceMessages().record(kept)))
    gone: Line = {"polygon_enu_m": None, "keep_out_enu_m": [], "margin_m": None}
    lines = [{"t_s": 0.5, "kind": "fence", **record}, {"t_s": 9.0, "kind": "fence", **gone}]
    page = page_of([*lines, *FLIGHT], limits)
    assert page.count('<polygon class="fence"') == 1
    assert page.count('<polygon class="obstacle"') == 1
    assert "dashed green" in page
    assert "red areas" in page


def test_hostile_texts_are_escaped() -> None:
    page = page_of([text(1.0, "<script>alert(1)</script>"), *FLIGHT])
    assert "<script>" not in page
    assert "&lt;script&gt;" in page


@pytest.mark.parametrize(
    "lines",
    [
        [],
        [text(1.0, "nothing else")],
        [estimate(1.0)],
        [{**estimate(1.0), "nis": None, "range_innovation": None, "covariance_m2": None}],
        [{"t_s": 1.0, "kind": "estimate"}, {"kind": "unheard of"}, {"t_s": "x", "kind": "link"}],
    ],
)
def test_a_poor_flight_has_a_report_too(lines: list[Line]) -> None:
    assert "Flight report" in page_of(lines)


def test_it_is_written_beside_the_flight(tmp_path: Path) -> None:
    write_facts(tmp_path, FACTS)
    (tmp_path / EVENTS).write_text("".join(json.dumps(line) + "\n" for line in FLIGHT))
    (tmp_path / "events.old.jsonl").write_text(json.dumps(text(0.1, "earlier")) + "\n")
    assert is_quick(tmp_path)
    path = write_report(tmp_path)
    assert path == tmp_path / "report.html"
    assert "earlier" in path.read_text()
    other = tmp_path / "other.html"
    assert write_report(tmp_path / EVENTS, other) == other
    assert other.read_text() == path.read_text()


@pytest.mark.parametrize("output", [".", "", "folder"])
def test_an_output_that_is_a_folder_is_refused_in_words(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    output: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    write_facts(tmp_path, FACTS)
    (tmp_path / EVENTS).write_bytes(b"")
    assert main(["report", str(tmp_path), "--output", output]) == EXIT_BAD_INPUT
    assert "is a folder; give the name of a file" in capsys.readouterr().err


def test_a_folder_without_a_flight_is_refused_in_words(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"flight\.json"):
        write_report(tmp_path)
    assert not is_quick(tmp_path)


@pytest.mark.parametrize(
    "line",
    [
        {"kind": "estimate", "t_s": 1.0, "position_enu_m": [1e300, 0.0], "r95_m": 1.0},
        {"kind": "estimate", "t_s": 1e300, "position_enu_m": [1.0, 0.0], "r95_m": 1.0},
        {"kind": "estimate", "t_s": 1.0, "position_enu_m": [1.0, 0.0], "r95_m": 1e300},
        {**estimate(2.0), "nis": 1e300, "range_innovation": -1e300},
        {**estimate(2.0), "sensor_enu_m": [1.0]},
        {**estimate(2.0), "covariance_m2": [[1e300, 0.0], [0.0, 1e300]]},
        {"kind": "waypoint", "t_s": 1.0, "position_enu_m": [-1e300, 0.0]},
        {"kind": "position", "t_s": 1.0, "position_enu_m": [1e300, 0.0, 0.0]},
        {"kind": "origin", "latitude_deg": 1e300, "longitude_deg": 8.5, "altitude_m": 400.0},
        {
            "kind": "origin",
            "latitude_deg": 47.0,
            "longitude_deg": 8.5,
            "altitude_m": 400.0,
            "scale_en": [0.0, 1.0],
        },
        {**RESULT, "emitter_id": 9, "latitude_deg": 1e300},
        {"kind": "fence", "t_s": 1.0, "polygon_enu_m": 3 * [[1e300, 0.0]]},
        {"kind": "link", "t_s": "soon", "links": 1e9, "loss": [None, {}]},
        {"kind": "radio", "number": 10**400, "name": {}},
        {"kind": "guard", "reasons": {"a": 1}},
        {"kind": "result", "t_s": 1.0, "r95_m": "wide", "latitude_deg": 1e300},
        {"kind": 3},
    ],
    ids=str,
)
def test_a_line_that_cannot_be_true_costs_only_itself(line: Line) -> None:
    summary = summarize_events([*FLIGHT, line])
    assert len(summary.estimates) == 40
    assert "localised, R95 0.40 m" in page_of([*FLIGHT, line])
