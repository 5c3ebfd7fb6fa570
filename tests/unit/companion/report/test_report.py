"""The flight report: one page, whole in itself, true to the event log, and safe to open."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree as ET

import msgspec
import pytest

from companion.config.schema import CompanionConfig, LimitsConfig
from companion.errors import ConfigError
from companion.flight_setup import FlightFacts, write_facts
from companion.guard.fence import Fence
from companion.guard.gate import GuardReason
from companion.guidance.messages import FenceMessages, GuardMessages
from companion.io.files import EVENTS
from companion.report.flight_summary import summarize_events
from companion.report.page import is_quick, report_page, verdict_of, write_report

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
    """What a page loads, and the elements in it."""

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


def test_counters_of_the_link_are_told_in_words() -> None:
    link: Line = {"t_s": 1.0, "kind": "link", "lost": 3, "refused": {}, "new_one": {"late": 2}}
    page = page_of([*FLIGHT, link])
    rows = dict(re.findall("<div><dt>([^<]*)</dt><dd>([^<]*)</dd></div>", page))
    assert rows["frames lost"] == "3"
    assert rows["measurements rejected"] == "none"
    assert rows["new one"] == "late: 2"


def test_the_verdict_is_what_the_flight_came_to() -> None:
    assert verdict_of(summarize_events(FLIGHT)) == "localised, R95 0.40 m"
    assert verdict_of(summarize_events(FLIGHT[:-1])) == "not reported: searching, R95 0.5 m"
    assert verdict_of(summarize_events([])) == "no measurement of the emitter was used"


@pytest.mark.parametrize(("is_told", "words"), [(True, "told"), (False, "not told")])
def test_both_radii_are_told_where_the_log_has_both(is_told: bool, words: str) -> None:
    own = {"absolute_r95_m": 3.7, "own_sigma_m": 1.5, "own_sigma_told": is_told}
    lines = [{**estimate(1.0), **own}, {**RESULT, **own}]
    told = f"R95 0.40 m, absolute 3.70 m (own place 1.50 m, {words})"
    assert verdict_of(summarize_events(lines)) == f"localised, {told}"
    page = page_of(lines)
    assert f"reported: localised, {told}" in page
    assert page.count('<circle class="radius"') == page.count('<circle class="absolute"') == 1
    assert '<circle class="absolute"' not in page_of(FLIGHT)


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


def test_a_folder_without_a_flight_is_refused_in_words(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"flight\.json"):
        write_report(tmp_path)
    assert not is_quick(tmp_path)
