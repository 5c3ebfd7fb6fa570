from __future__ import annotations

import re
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import msgspec
import pytest

from companion.errors import CompanionError
from sim_link.world.environment import ObstacleParams
from tests.unit.tools.study.reporting.case_helpers import canonical_case
from tests.unit.tools.study.reporting.invented import cell, row, study, tally
from tools.study.case import Case
from tools.study.reporting.study_report import (
    _commit,
    open_points,
    page,
    sections_of,
    title_of,
    verdict_line,
    write_page,
)
from tools.study.study import FigureName, ResultRow, StudyResult

MADE_WITH = {"commit": "0123abcd", "numpy": "2.0"}
VOID = {"meta", "link", "br", "img", "use", "path", "hr"}


class Balance(HTMLParser):
    """Tags that are open, and ids."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.ids += [value or "" for name, value in attrs if name == "id"]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        del tag
        self.ids += [value or "" for name, value in attrs if name == "id"]

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag


def small_study(figures: tuple[FigureName, ...] = ()) -> tuple[StudyResult, list[ResultRow]]:
    names = ("map/latched", "asymmetric_huber/reactive")
    cells = [cell(name, tally(0.02), value=value) for value in ("0.5", "1.5") for name in names]
    rows = [row(c.system, "0.02", "0.41", ci95="0.01..0.03", value=c.value) for c in cells]
    return study(*cells, title="Small & <quick>", figures=figures), rows


def text_of(results: list[StudyResult], rows: list[ResultRow]) -> str:
    return page(sections_of(results, rows), rows, [], MADE_WITH)


@pytest.mark.slow
def test_a_small_study_makes_a_whole_page() -> None:
    result, rows = small_study(("losses", "offsets"))
    text = text_of([result], rows)
    reader = Balance()
    reader.feed(text)
    assert reader.open == []
    assert len(reader.ids) == len(set(reader.ids))
    assert "Small &amp; &lt;quick&gt;" in text
    assert "Why &amp; how." in text
    assert "0123abcd" in text
    assert text.count("<figure") == 3


def test_the_page_needs_no_network_and_no_scripts() -> None:
    result, rows = small_study(("losses",))
    text = text_of([result], rows)
    assert "<script" not in text
    for address in re.findall(r'(?:src|href)="([^"]+)"', text):
        assert address.startswith("#"), address
    assert "@import" not in text
    assert not re.search(r"url\((?!#)", text)


def test_the_page_is_the_same_bytes_twice() -> None:
    pages = [text_of(*([one[0]], one[1])) for one in (small_study() for _ in range(2))]
    assert pages[0] == pages[1]


def test_a_table_shared_by_two_studies_is_shown_once() -> None:
    result, rows = small_study()
    first, second = sections_of([result, result], rows)
    assert len(first.tables) == 1
    assert second.tables == ()


def test_files_are_written_whole(tmp_path: Path) -> None:
    result, rows = small_study(("losses",))
    write_page(tmp_path, sections_of([result], rows), rows)
    names = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.*")}
    assert names == {
        "report.html",
        "figures/grand_summary_losses.svg",
        "figures/grand_summary_losses.png",
    }


def test_a_folder_in_the_way_is_said(tmp_path: Path) -> None:
    result, rows = small_study()
    (tmp_path / "figures").write_text("")
    with pytest.raises(CompanionError, match=r"figures: .*choose another --out"):
        write_page(tmp_path, sections_of([result], rows), rows)


@pytest.mark.slow
def test_tracks_and_gradients_are_flown_behind_an_obstacle() -> None:
    block = ObstacleParams(corners_enu_m=((30.0, 30.0), (45.0, 30.0), (45.0, 60.0), (30.0, 60.0)))
    case = msgspec.structs.replace(canonical_case(p_nlos=0.1), steps=6, obstacles=(block,))
    at = cell("map/latched", tally(0.02), "obstacle", "block", "scene", case)
    (section,) = sections_of([study(at, figures=("tracks", "gradients"))], [])
    assert [drawing.name for drawing in section.drawings] == [
        "obstacle_tracks",
        "obstacle_gradients",
    ]
    assert "5 steps" in section.drawings[1].caption


def test_open_points_follow_the_case() -> None:
    points = {point: choice for point, choice, _ in open_points(Case(steps=321))}
    assert points["Horizon"] == "321 steps"
    assert points["Lawnmower"].endswith("the first at 2.5 m")


def test_titles() -> None:
    result, _ = small_study()
    assert title_of([result]) == "Small & <quick>"
    assert title_of([result, result]) == "The paper's evaluation, measured"
    assert verdict_line([]) == ""


def test_outside_of_a_checkout_the_commit_is_unknown(tmp_path: Path) -> None:
    assert _commit(tmp_path) == "unknown"


def test_local_changes_are_reported(tmp_path: Path) -> None:
    git = ["git", "-C", str(tmp_path), "-c", "user.name=A", "-c", "user.email=a@example.org"]
    (tmp_path / "file").write_text("one")
    for arguments in (["init", "-q"], ["add", "file"], ["commit", "-q", "-m", "one"]):
        subprocess.run([*git, *arguments], check=True)
    clean = _commit(tmp_path)
    assert re.fullmatch(r"[0-9a-f]{12}", clean)
    (tmp_path / "file").write_text("another")
    assert _commit(tmp_path) == f"{clean} with local changes"
