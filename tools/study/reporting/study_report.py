"""`report.html` of a study: one page with verdicts, tables and figures, complete in itself.

The page needs no network and no scripts. Its account of the scenario and of the paper's open points
is read from the canonical case, so that it cannot differ from the code.
"""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
from markupsafe import Markup

from companion.io.files import write_bytes_atomic, write_text_atomic
from companion.kernel import IS_COMPILED
from companion.report.page import page_environment
from sim_link.lab.pool import version_of
from tools.study.case import STUDY_SHADOW, Case
from tools.study.reporting.claims import Claim, Findings, claims_of
from tools.study.reporting.figures import drawings_of
from tools.study.reporting.plots import Drawing, inline
from tools.study.reporting.tables import (
    TableView,
    count_verdicts,
    tables_of,
    typeset,
)
from tools.study.study import ResultRow, StudyResult
from tools.study.study_run import made_folder


def open_points(case: Case) -> list[tuple[str, str, str]]:
    """Return every point that the paper leaves open, the choice fixed in a case, and the reason."""
    text = (Path(__file__).parent / "templates" / "open_points.yaml").read_bytes()
    position_sigma_m, offset_sigma_m = case.belief.prior[1][[0, 2]].tolist()
    first_m, is_joint = case.first_lane_north_m, case.nlos_draws == "joint"
    values = {
        "case": case,
        "channel": case.channel,
        "belief": case.belief,
        "shadow": STUDY_SHADOW,
        "nlos_draw": "one" if is_joint else "one each",
        "together": " together" if is_joint else "",
        "position_sigma_m": position_sigma_m,
        "offset_sigma_m": offset_sigma_m,
        "first_lane_m": 0.5 * case.lane_spacing_m if first_m is None else first_m,
    }
    points = msgspec.yaml.decode(text, type=list[tuple[str, str, str]])
    return [(point, choice.format(**values), reason) for point, choice, reason in points]


FIGURES = "figures"
"""Folder of the figures, next to the page."""
SHOWN_VERSIONS = ("numpy", "scipy", "numba", "filterpy", "matplotlib")
UNKNOWN = "unknown"
GIT_LIMIT_S = 5.0
ROOT = Path(__file__).resolve().parents[3]


@dataclass(frozen=True, slots=True)
class Section:
    """One study on the page."""

    result: StudyResult
    drawings: tuple[Drawing, ...]
    tables: tuple[TableView, ...]


def write_page(
    out: Path,
    sections: Sequence[Section],
    rows: Sequence[ResultRow],
    costs: Sequence[ResultRow] = (),
) -> None:
    """Write the figures, PNG and SVG, and `report.html`; raises a CompanionError if that fails."""
    folder = made_folder(out / FIGURES)
    for drawing in (drawing for section in sections for drawing in section.drawings):
        write_bytes_atomic(folder / f"{drawing.name}.svg", drawing.svg.encode())
        write_bytes_atomic(folder / f"{drawing.name}.png", drawing.png)
    write_text_atomic(out / "report.html", page(sections, rows, costs, provenance()))


def sections_of(results: Sequence[StudyResult], rows: Sequence[ResultRow]) -> list[Section]:
    """Return the studies, drawn and tabled; the first shows a table that two studies share."""
    tables = tables_of(rows)
    taken: set[str] = set()
    sections: list[Section] = []
    for result in results:
        names = {cell.table for cell in result.cells} - taken
        taken |= names
        shown = tuple(table for table in tables if table.table in names)
        sections.append(Section(result, tuple(drawings_of(result, rows)), shown))
    return sections


def page(
    sections: Sequence[Section],
    rows: Sequence[ResultRow],
    costs: Sequence[ResultRow],
    made_with: Mapping[str, str],
) -> str:
    """Return the page as text."""
    environment = page_environment("tools.study.reporting")
    environment.filters["set"] = typeset
    environment.filters["inline"] = lambda drawing: Markup(inline(drawing))
    results = [section.result for section in sections]
    claims = claims_of(Findings(results, rows, costs))
    return environment.get_template("report.html.j2").render(
        title=title_of(results),
        claims=claims,
        verdict=verdict_line(claims),
        counts=count_verdicts([table for section in sections for table in section.tables]),
        sections=sections,
        costs=tables_of(costs),
        open_points=open_points(Case()) if any(result.cells for result in results) else (),
        made_with=made_with,
        runs=sorted({result.runs for result in results}),
        seeds=sorted({result.seed for result in results}),
    )


def title_of(results: Sequence[StudyResult]) -> str:
    """Return the title of the page."""
    return results[0].study.title if len(results) == 1 else "The paper's evaluation, measured"


def verdict_line(claims: Sequence[Claim]) -> str:
    """Return the text of the number of claims met."""
    if not claims:
        return ""
    met = sum(claim.is_met for claim in claims)
    if met == len(claims):
        return f"All {met} claims that this run can judge are met"
    return f"{met} of {len(claims)} claims are met"


def provenance() -> dict[str, str]:
    """Return the `commit` of the running code, and the versions of its dependencies."""
    found = {"commit": _commit(ROOT), "Python": platform.python_version()}
    for name in SHOWN_VERSIONS:
        number = version_of(name)
        found[name] = "not installed" if number == "none" else number
    return found | {"kernels": "compiled" if IS_COMPILED else "plain Python"}


def _commit(root: Path) -> str:
    """Return the commit of the checkout, and whether files differ from it."""
    if not (root / ".git").exists():
        return UNKNOWN
    options = ("--always", "--abbrev=12", "--exclude=*", "--dirty= with local changes")
    command = ["git", "-C", str(root), "describe", *options]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=GIT_LIMIT_S)
    except (OSError, subprocess.TimeoutExpired):
        return UNKNOWN
    return done.stdout.strip() if done.returncode == 0 else UNKNOWN
