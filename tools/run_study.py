"""Runs a study and writes its tables, figures and report; killed or stopped, it can be resumed.

Exit code 1: stopped, a backend failed, or a limit is exceeded. 2: bad input.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from companion.entry import ignore_broken_pipe, obey_termination
from companion.errors import CompanionError, ConfigError
from companion.io.files import write_json_atomic, write_text_atomic
from sim_link.lab.pool import WorkerLostError, open_pool
from tools.console import OneLineParser, csv_text, done_by, non_negative, positive, say
from tools.study import search_planners, searched_area, study_run
from tools.study.field_flights import flights_of, fly
from tools.study.power_pairs import fly_both, table_of_power
from tools.study.reporting.area_report import table_of_area, write_reliability
from tools.study.reporting.field_report import drawing_of, markdown_of, summary_of
from tools.study.reporting.study_report import Section, sections_of, write_page
from tools.study.reporting.study_tables import rows_of, studies_of
from tools.study.reporting.tables import tables_of
from tools.study.searched_prior import fly_pair, table_of_pairs
from tools.study.step_costs import costs_of
from tools.study.study import FlightRow, ResultRow, Study, StudyResult

STUDIES = Path(__file__).resolve().parent.parent / "configs" / "studies"


def main() -> int:
    """Run or resume a study, and write its folder; return the exit code."""
    arguments = parsed()
    obey_termination()
    try:
        out: Path = arguments.out or Path("studies") / Path(arguments.study).stem
        if arguments.study in SIMULATED:
            return run_simulated(arguments, out)
        studies = studies_of(arguments.study, STUDIES)
        if arguments.runs:
            studies = [msgspec.structs.replace(study, runs=arguments.runs) for study in studies]
        if studies[0].flights is not None:
            return run_flights(studies[0], arguments, out)
        if arguments.only:
            raise ConfigError("--only: this study has no flights to choose from")
        return run(studies, arguments, out)
    except ConfigError as error:
        code, text = 2, str(error)
    except WorkerLostError as error:
        code, text = 1, f"{error}; run the same command again to go on"
    except CompanionError as error:
        code, text = 1, str(error)
    except KeyboardInterrupt:
        kept, on = "what is done is kept, ", " to go on"
        kept, on = ("", "") if arguments.study in SIMULATED else (kept, on)
        code, text = 1, f"stopped; {kept}run the same command again{on}"
    say(f"run_study: {text}")
    return code


def parsed() -> argparse.Namespace:
    """Return the parsed command line."""
    parser = OneLineParser(description=__doc__)
    parser.add_argument(
        "study",
        metavar="STUDY",
        help="a name in configs/studies, a YAML file, area, search, prior or power",
    )
    parser.add_argument("--runs", type=positive, help="runs of every cell")
    parser.add_argument("--seed", type=non_negative, default=1)
    parser.add_argument("--jobs", type=positive, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--backend", default="local", help="local, or dask://HOST:PORT")
    parser.add_argument(
        "--only",
        action="append",
        default=[],
        metavar="NAME",
        help="in a study of flights: this radio, configuration or planner; may be given again",
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="default: studies/STUDY")
    return parser.parse_args()


def run(studies: list[Study], arguments: argparse.Namespace, out: Path) -> int:
    """Run after the arguments are checked: nothing is made before the backend is there."""
    work = study_run.work_of(studies, arguments.seed)
    with open_pool(arguments.backend, arguments.jobs) as pool:
        store = study_run.Store(out / study_run.FOLDER_NAME)
        say("kernels that were not compiled before take a minute or two first")
        study_run.carried_out(
            work, study_run.tallied, study_run.cost_of, pool, store, "blocks of runs"
        )
        written(studies, store, arguments.seed, out)
    return 0


def written(studies: list[Study], store: study_run.Store, seed: int, out: Path) -> None:
    """Write tables and the report of finished work."""
    results = study_run.results_of(studies, seed, store)
    rows = [row for result in results for row in rows_of(result)]
    costs = costs_of(results)
    write_text_atomic(out / "results.csv", table_text(rows))
    write_text_atomic(out / "costs.csv", table_text(costs))
    write_page(out, sections_of(results, rows), rows, costs)
    say(f"{out}: results.csv, costs.csv, report.html")


def run_flights(study: Study, arguments: argparse.Namespace, out: Path) -> int:
    """Run a study of flights; after an interruption the finished flights are written, too."""
    assert study.flights is not None
    seed = arguments.seed
    flights = flights_of(study.flights, STUDIES.parent, study.runs, seed, arguments.only)
    work = {flight.key: flight for flight in flights}
    with open_pool(arguments.backend, arguments.jobs) as pool:
        store = study_run.Store(out / study_run.FOLDER_NAME)
        try:
            study_run.carried_out(work, fly, lambda flight: flight.cut_s, pool, store, "flights")
        finally:
            kept = store.found(work).values()
            write_flights(
                study, [msgspec.json.decode(row, type=FlightRow) for row in kept], seed, out
            )
    return 0


def write_flights(study: Study, flown: Sequence[FlightRow], seed: int, out: Path) -> None:
    """Write tables and the report of flights."""
    rows = summary_of(flown)
    write_text_atomic(out / "flights.csv", table_text(flown, FlightRow.__struct_fields__))
    write_json_atomic(out / "flights.json", msgspec.to_builtins(flown))
    write_text_atomic(out / "results.csv", table_text(rows))
    write_text_atomic(out / "results.md", markdown_of(rows))
    if flown:
        runs = len({row.seed for row in flown})
        result = StudyResult(study, runs, seed, ())
        write_page(out, [Section(result, (drawing_of(flown),), tuple(tables_of(rows)))], rows)
    say(f"{out}: flights.csv, flights.json, results.csv, results.md, report.html")


def run_simulated(arguments: argparse.Namespace, out: Path) -> int:
    """Fly a study that no file describes; write the results of its flights, in order."""
    study = SIMULATED[arguments.study]
    runs, fly = range(arguments.runs or study.flights), partial(study.fly, seed=arguments.seed)
    study_run.made_folder(out)
    flown = done_by(fly, runs, arguments.jobs, backend=arguments.backend)
    table, is_met = study.table_of(flown)
    write_text_atomic(out / f"{arguments.study}.txt", table)
    study.write_beside(out, flown)
    print(table, end="")
    if is_met:
        return 0
    say(f"run_study: {study.failure}")
    return 1


@dataclass(frozen=True, slots=True)
class SimulatedStudy:
    """Study of flights that are numbered, and drawn from number and seed alone."""

    fly: Callable[..., Any]
    flights: int
    table_of: Callable[[list[Any]], tuple[str, bool]]
    """Return the table of all flights, and True within the limits."""
    failure: str
    write_beside: Callable[[Path, list[Any]], None] = lambda *_: None
    """Write other files than the table into a folder."""


SIMULATED = {
    "area": SimulatedStudy(
        searched_area.fly,
        2000,
        table_of_area,
        "a stated probability is off by more than 3 %",
        write_reliability,
    ),
    "power": SimulatedStudy(
        fly_both,
        100,
        table_of_power,
        "flights with received power are the worse ones",
        lambda out, flown: write_json_atomic(out / "flights.json", flown),
    ),
    "prior": SimulatedStudy(  # in more than half of the flights a contact follows a search
        fly_pair, 400, table_of_pairs, "the searched prior delays a fix"
    ),
    "search": SimulatedStudy(
        search_planners.fly_planners,
        100,
        search_planners.table_of,
        "the planner `probability` exceeds a limit",
    ),
}
ROW_NAMES = tuple(field.name for field in fields(ResultRow))


def table_text(rows: Sequence[object], names: Sequence[str] = ROW_NAMES) -> str:
    """Return rows as a CSV file with their header."""
    return csv_text(names, ([getattr(row, name) for name in names] for row in rows))


if __name__ == "__main__":
    ignore_broken_pipe()
    sys.exit(main())
