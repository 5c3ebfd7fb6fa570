"""Reports of flights: the page, JUnit XML, the event log and lines for people."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from html.parser import HTMLParser
from xml.etree import ElementTree

import msgspec
import pytest

from companion.report.charts import MAX_POINTS, SvgPlot, square_around, thin_points
from companion.report.flight_summary import EstimatePoint
from sim_link.lab.mission.batch import (
    invariants_of,
    report_page,
)
from sim_link.lab.mission.mission_cli import PlainProgress, campaign_lines, junit_xml, progress_for
from sim_link.lab.mission.results import (
    ExpectationVerdict,
    FlightRecord,
    MissionResult,
    OperatorText,
    Report,
    StepOutcome,
)
from sim_link.lab.mission.script_file import parse_mission
from sim_link.lab.monitor.monitor import WIRE
from sim_link.lab.monitor.scene import InvariantViolation

HOSTILE = '<script>alert("x")</script> & \x07'


def result_of(is_met: bool = True, seed: int = 3, text: str = "LOCALISED") -> MissionResult:
    mission = parse_mission("name: two <rubble> heaps\nabout: A & B\nsteps: [connect]\n", "m")
    record = FlightRecord(
        steps=[StepOutcome(1, "connect", "hearing it", 0.0, 1.0, "" if is_met else "refused")],
        events=[
            (0.0, "step", {"step": 1, "name": "connect", "what": "hearing it"}),
            (1.0, "step ended", {"step": 1, "name": "connect", "failure": ""}),
            (2.0, "phase", {"old": "hold", "new": "normal", "trigger": "x"}),
            (3.0, "text", {"severity": "info", "text": text}),
            (4.0, "result", {"r95_m": 0.5}),
        ],
        estimates=[
            EstimatePoint(
                t / 10,
                (50.0 + 10 / t, 50.0),
                20 / t,
                "ambiguous",
                range_innovation_m=5 / t,
                emitter_id=1,
            )
            for t in range(1, 100)
        ],
        reports=[Report(10.0, 1, (50.1, 50.0), 0.5)],
        texts=[OperatorText(3.0, "companion", text), OperatorText(5.0, "autopilot", HOSTILE)],
        violations=[InvariantViolation(6.0, "I7", "a gap")],
        track=[(t / 5, (float(t), float(t), 20.0)) for t in range(50)],
        ended_s=12.0,
        distance_m=99.0,
        closest_approach_m=8.0,
        wall_s=0.05,
    )
    verdicts = (
        ExpectationVerdict("all steps", True, "1 done"),
        ExpectationVerdict("close", is_met, HOSTILE),
    )
    return MissionResult(mission, "missions/two.yaml", seed, "lockstep", record, verdicts)


class _Page(HTMLParser):
    """Collects tags, addresses and text."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.text = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [v or "" for k, v in attrs if k in ("src", "href")]

    def handle_data(self, data: str) -> None:
        self.text += data


def test_the_page_is_complete_in_itself_and_escapes_what_strangers_say() -> None:
    page = _Page(report_page(result_of()))
    assert page.addresses == []
    assert "script" not in page.tags
    assert page.tags.count("svg") == 5
    for words in ("two <rubble> heaps", "passed", "A & B", HOSTILE[:20], "✓"):
        assert words in page.text


def test_the_page_says_of_every_invariant_whether_it_was_kept_broken_or_not_judged() -> None:
    result = result_of()
    assert {violations for _, _, violations, _ in invariants_of(result.record)} == {None}
    result.record.scope, result.record.slack_s = WIRE, 1.25
    rows = {name: verdict for name, _, *verdict in invariants_of(result.record)}
    assert list(rows) == [f"I{number}" for number in range(1, 14)]
    assert (rows["I2"][0], rows["I7"][0]) == (0, 1)
    assert rows["I8"] == [None, WIRE.unjudged["I8"]]
    page = _Page(report_page(result))
    for words in ("broken once", "kept", "not judged", WIRE.unjudged["I12"], "1.25 s"):
        assert words in page.text


def test_the_page_says_whose_error_it_is_where_there_are_several_emitters() -> None:
    result = result_of()
    assert "of emitter 1" not in _Page(report_page(result)).text
    several = msgspec.structs.replace(result.mission, emitters=(result.mission.emitter,))
    text = _Page(report_page(replace(result, mission=several))).text
    assert "Final error of emitter 1" in text
    assert "R95 of emitter 1" in text


def test_the_page_of_a_failed_flight_says_what_failed() -> None:
    page = _Page(report_page(result_of(is_met=False)))
    assert "failed" in page.text
    assert "refused" in page.text
    assert "I7: a gap" in page.text


def test_the_page_of_a_flight_that_saw_nothing_has_no_charts() -> None:
    result = result_of()
    record = FlightRecord(failure="nothing heard", ended_s=1.0)
    empty = MissionResult(
        result.mission,
        "m.yaml",
        0,
        "lockstep",
        record,
        (ExpectationVerdict("all steps", False, "no"),),
    )
    page = _Page(report_page(empty))
    assert page.tags.count("svg") == 1


def test_a_reports_name_is_a_file_name() -> None:
    result = result_of()
    assert result.flight_name == "two-rubble-heaps-px4-lockstep-seed3"
    long = msgspec.structs.replace(result.mission, name="x" * 400)
    link = replace(result, mission=long, how="udpin:127.0.0.1:14550")
    assert link.flight_name == f"{'x' * 80}-px4-udpin-127.0.0.1-14550-seed3"


def test_junit_counts_cases_and_names_failures() -> None:
    summaries = [result_of().without_history(), result_of(is_met=False, seed=4).without_history()]
    root = ElementTree.fromstring(junit_xml(summaries))
    assert (root.get("tests"), root.get("failures")) == ("4", "1")
    failed = [case for case in root.iter("testcase") if case.find("failure") is not None]
    assert [case.get("name") for case in failed] == ["close"]
    failure = failed[0].find("failure")
    assert failure is not None
    assert "alert" in (failure.get("message") or "")
    assert root[1].get("name") == "two <rubble> heaps (px4), seed 4"


def test_a_flight_that_came_to_no_end_is_an_error_and_no_pass() -> None:
    whole = result_of().without_history()
    unwritten = replace(whole, error="disk full")
    unflown = replace(
        whole,
        error="port taken",
        verdicts=(),
        record=replace(whole.record, ended_s=0.0, wall_s=0.0),
    )
    assert whole.is_passed
    assert not unwritten.is_passed
    assert not unflown.is_passed
    root = ElementTree.fromstring(junit_xml([whole, unwritten, unflown]))
    assert [root.get(name) for name in ("tests", "failures", "errors")] == ["6", "0", "2"]
    assert [suite.get("errors") for suite in root] == ["0", "1", "1"]
    assert [error.get("message") for error in root.iter("error")] == ["disk full", "port taken"]
    output = io.StringIO()
    progress = PlainProgress(2, output, is_detailed=False)
    for summary in (unwritten, unflown):
        progress.finished(summary)
    first, reason, second, other = output.getvalue().splitlines()
    assert first.startswith("FAIL [1/2]")
    assert second == "FAIL [2/2] two <rubble> heaps (px4), seed 3: not flown to its end"
    assert (reason.strip(), other.strip()) == ("disk full", "port taken")
    assert campaign_lines([unflown])[0] == (
        "two <rubble> heaps (px4): 0/1 passed, error at most 0.10 m, 1/1 inside R95"
    )


def test_a_script_that_does_not_fit_is_neither_passed_nor_failed() -> None:
    record = FlightRecord(autopilot="ardupilot", skipped="the script is for px4")
    skipped = replace(result_of(), record=record, verdicts=()).without_history()
    suite = ElementTree.fromstring(junit_xml([skipped]))[0]
    counts = [suite.get(name) for name in ("tests", "failures", "errors", "skipped")]
    assert counts == ["1", "0", "0", "1"]
    assert [each.get("message") for each in suite.iter("skipped")] == ["the script is for px4"]
    output = io.StringIO()
    PlainProgress(1, output, is_detailed=False).finished(skipped)
    title = "two <rubble> heaps (ardupilot)"
    assert output.getvalue() == f"SKIP [1/1] {title}, seed 3: the script is for px4\n"
    lines = campaign_lines([skipped, result_of().without_history()])
    assert lines[0] == f"{title}: 1 skipped"
    assert lines[2].startswith("1 of 1 flights passed, 1 skipped; ")


def test_the_event_log_is_json_lines_with_the_verdicts_last() -> None:
    lines = [json.loads(line) for line in result_of().event_log.splitlines()]
    assert lines[0] == {
        "t_s": 0.0,
        "kind": "step",
        "step": 1,
        "name": "connect",
        "what": "hearing it",
    }
    assert [line["kind"] for line in lines][-2:] == ["verdict", "verdict"]


def test_a_result_measures_against_the_truth() -> None:
    result = result_of()
    assert result.final_error_m == pytest.approx(10 / 99)
    assert result.is_inside_r95
    assert result.is_passed
    assert not result_of(is_met=False).is_passed


def test_a_campaign_is_summed_up_by_mission() -> None:
    summaries = [result_of(seed=seed).without_history() for seed in range(3)]
    summaries.append(result_of(is_met=False, seed=3).without_history())
    lines = campaign_lines(summaries)
    assert lines[0].startswith("two <rubble> heaps (px4): 3/4 passed, error at most 0.10 m, 4/4")
    assert lines[1].startswith("3 of 4 flights passed")
    assert "240 times real time" in lines[1]
    assert "processor" not in lines[1]


def test_plain_progress_tells_steps_of_one_flight_and_results_of_many() -> None:
    output = io.StringIO()
    progress = progress_for(2, 1, output)
    progress.finished(result_of().without_history())
    progress.finished(result_of(is_met=False).without_history())
    lines = output.getvalue().splitlines()
    assert lines[0].startswith("PASS [1/2] two <rubble> heaps (px4), seed 3: 12.0 s, error 0.10 m")
    assert lines[1].startswith("FAIL [2/2]")
    assert lines[2].strip().startswith("close: ")


@pytest.mark.parametrize(("late_s", "is_announced"), [(0.9, True), (0.1, False)])
def test_a_failure_on_a_busy_computer_comes_with_what_to_do(
    late_s: float, is_announced: bool
) -> None:
    result = result_of(is_met=False)
    result.record.late_s = late_s
    output = io.StringIO()
    PlainProgress(1, output, is_detailed=True).finished(result.without_history())
    assert ("too busy" in output.getvalue()) is is_announced


def test_a_busy_computer_is_no_news_where_the_mission_passed() -> None:
    result = result_of()
    result.record.late_s = 0.9
    assert result.without_history().doubt == ""


def test_a_summary_knows_its_report_and_its_speed() -> None:
    summary = replace(result_of().without_history(), report="a.html")
    assert 'value="a.html"' in junit_xml([summary])
    assert summary.times_real_time == pytest.approx(240.0)


def test_curves_are_thinned_and_axes_have_round_ticks() -> None:
    points = [(float(n), float(n)) for n in range(10 * MAX_POINTS)]
    thin = thin_points(points)
    assert len(thin) <= MAX_POINTS + 1
    assert (thin[0], thin[-1]) == (points[0], points[-1])
    drawing = SvgPlot(600, 300, (0.0, 97.0), (0.01, 120.0), "t", is_log=True)
    assert drawing.x.ticks() == [0.0, 20.0, 40.0, 60.0, 80.0]
    assert drawing.y.ticks() == pytest.approx([0.01, 0.1, 1.0, 10.0, 100.0])
    assert square_around([(0.0, 0.0), (10.0, 4.0)], 1.0) == (-1.0, 11.0, -4.0, 8.0)
