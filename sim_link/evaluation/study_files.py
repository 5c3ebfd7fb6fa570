"""Studies in YAML files, and the tables that come out of them."""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Sequence
from dataclasses import astuple, fields
from pathlib import Path
from typing import get_args

from companion.config.loader import load_yaml
from companion.errors import CompanionError, ConfigError
from sim_link.evaluation.results import ResultRow
from sim_link.evaluation.study import FigureName, Metric, Study, Sweep, SystemGrid, cells_of, hint
from sim_link.evaluation.systems import FilterName, PlannerName

SUFFIX = ".yaml"
_UNKNOWN_KEY = re.compile(r"(?P<key>[^.\s]+): unknown key; ")
_UNKNOWN_NAME = re.compile(
    r"(?P<list>filters|planners|metrics|paper|figures)\S*: "
    r"(?P<problem>Invalid enum value '(?P<name>.*)')"
)
_KNOWN: dict[str, tuple[str, ...]] = {
    "filters": get_args(FilterName),
    "planners": get_args(PlannerName),
    "metrics": get_args(Metric),
    "paper": get_args(Metric),
    "figures": get_args(FigureName),
}


def studies_of(name: str, folder: Path) -> list[Study]:
    """The studies of a name or file: itself, or those that it collects, each checked.

    Args:
        name: Of a study in the folder, or the path of a YAML file.
        folder: Of the studies that come with the project.

    Raises:
        ConfigError: There is no such study, or it is wrong; one line says where.
    """
    return _collected(study_path(name, folder), folder, ())


def study_path(name: str, folder: Path) -> Path:
    """The file of a study.

    Raises:
        ConfigError: There is none.
    """
    if name.endswith((SUFFIX, ".yml")) or os.sep in name:
        return Path(name)
    path = folder / f"{name}{SUFFIX}"
    if not path.is_file():
        known = sorted(path.stem for path in folder.glob(f"*{SUFFIX}"))
        raise ConfigError(f"study {name}: there is none of this name; {hint(name, known)}")
    return path


def load_study(path: Path) -> Study:
    """The study in a file, all of its cells checked.

    Raises:
        ConfigError: The file cannot be read or does not hold a study; one line says where.
    """
    try:
        study = load_yaml(path, Study)
    except ConfigError as error:
        raise ConfigError(_with_hint(str(error))) from None
    if bool(study.studies) == bool(study.sweeps):
        raise ConfigError(f"{path}: $: give `sweeps`, or `studies` of a collection")
    try:
        cells_of(study)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    return study


def csv_text(rows: Sequence[ResultRow]) -> str:
    """Rows as a CSV file has them, with their header."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([field.name for field in fields(ResultRow)])
    writer.writerows(astuple(row) for row in rows)
    return text.getvalue()


def write_text_atomic(path: Path, text: str) -> None:
    """Replace a text file as a whole: a reader sees the old one or the new one.

    Raises:
        CompanionError: It cannot be written; an old file is still there then.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("w", encoding="utf-8", newline="") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise CompanionError(f"{path}: cannot be written ({error.strerror})") from error


def check_folder(path: Path) -> None:
    """Make sure that a folder can be written into, or be made; nothing is made yet.

    Raises:
        ConfigError: It cannot.
    """
    place = path
    while not place.exists() and place != place.parent:
        place = place.parent
    if not place.is_dir():
        raise ConfigError(f"--out {path}: {place} is a file; choose a folder")
    if not os.access(place, os.W_OK | os.X_OK):
        raise ConfigError(f"--out {path}: {place} cannot be written; check its permissions")


def make_folder(path: Path) -> None:
    """Make a folder with all above it, if it is not there.

    Raises:
        ConfigError: It cannot be made, or not be written into.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / f".probe.{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ConfigError(f"--out {path}: cannot be written ({error.strerror})") from None


def _collected(path: Path, folder: Path, above: tuple[Path, ...]) -> list[Study]:
    if path in above:
        raise ConfigError(f"{path}: $.studies: the collection contains itself")
    study = load_study(path)
    if not study.studies:
        return [study]
    found: list[Study] = []
    for name in study.studies:
        try:
            inner = study_path(name, folder)
        except ConfigError as error:
            raise ConfigError(f"{path}: $.studies: {error}") from None
        found += _collected(inner, folder, (*above, path))
    return found


def _with_hint(problem: str) -> str:
    """With what a misspelt key or name may have been meant to be."""
    key, name = _UNKNOWN_KEY.search(problem), _UNKNOWN_NAME.search(problem)
    if key:
        names = [field for kind in (Study, Sweep, SystemGrid) for field in kind.__struct_fields__]
        return f"{problem[: key.end()]}{hint(key['key'], names)}"
    if name:
        near = hint(name["name"], _KNOWN[name["list"]])
        return f"{problem[: name.start('problem')]}there is no `{name['name']}`; {near}"
    return problem
