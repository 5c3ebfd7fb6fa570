"""Mission files: YAML to `Mission`, with errors that name file, line and path.

`mission.yaml:17: $.steps[3].wait_until.limit_s: expected a number > 0.0`
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import yaml

from companion.config.loader import parse_yaml, read_text
from companion.config.schema import CompanionConfig, inconsistency, load_config
from companion.config.versions import renew
from companion.errors import ConfigError
from sim_link.autopilot.incidents import renew_scenario
from sim_link.fleet import load_scenario
from sim_link.lab.faults.fault_models import KINDS
from sim_link.lab.mission.conditions import ConditionError, did_you_mean, parse_condition
from sim_link.lab.mission.script import (
    STEP_KINDS,
    EmitterBound,
    Expectation,
    Mission,
    SearchStep,
    TakeoffStep,
    TextSeen,
    WaitUntilStep,
    numbers_by_name,
)

_TOKEN = re.compile(r"\.([^.\[\]]+)|\[(\d+)\]")
_MESSAGE = re.compile(r"^(?P<path>\$[^:]*): (?P<problem>.*)$", re.DOTALL)
_STEP = re.compile(r"^\$\.steps\[\d+\]$")
_UNKNOWN_STEP = re.compile(r"^\$\.steps\[\d+\]\.(?P<name>[^.\[\]]+)$")
_CHOICE = re.compile(r"^(?:Invalid value '(?P<tag>.*)'|(?P<word>.*) is none of .*)$")

STEPS = (*STEP_KINDS, "inject")
ONE_LINE = "must be one line"
MISSING = "required key is missing"
Problem = tuple[str, str]
"""Path in the script, and the error there."""


def load_mission(path: Path) -> Mission:
    """Return the checked mission of a YAML file; a `ConfigError` names the line of the error."""
    return parse_mission(read_text(path), str(path), path.parent)


def parse_mission(text: str, name: str, folder: Path = Path()) -> Mission:
    """Return the mission in YAML text called `name`; files that it names are in the folder."""
    try:
        mission = parse_yaml(text, Mission, name, lambda raw: _renew(raw, name, folder))
    except ConfigError as error:
        problems = _split_problems(str(error), name)
        if not problems:
            raise
        lines = [str(error_at(text, name, path, _with_hint(path, what))) for path, what in problems]
        raise ConfigError("\n".join(lines)) from None
    if isinstance(mission.companion, str):
        path = folder / str(mission.companion)
        try:
            config = load_config(path)
        except ConfigError as error:
            raise error_at(text, name, "$.companion", str(error)) from None
        mission = msgspec.structs.replace(mission, companion=config)
    for where, problem in _problems(mission):
        raise error_at(text, name, where, problem)
    return mission


def _renew(raw: dict[str, Any], name: str, folder: Path) -> None:
    """Rename old keys, and add the file's scenario where the script has none."""
    renew_scenario(raw)
    if isinstance(raw.get("companion"), dict):
        renew(raw["companion"], f"{name}: $.companion")
    path = raw.pop("scenario", None)
    if isinstance(path, str):
        for key, value in msgspec.to_builtins(load_scenario(folder / path)).items():
            raw.setdefault(key, value)
    elif path is not None:
        raw["scenario"] = path  # an unknown key, unless it is a name


def flown_config(mission: Mission) -> CompanionConfig:
    """Return the companion's configuration with the script's search in it."""
    config = mission.config
    search = next((step for _, step in mission.named_steps if isinstance(step, SearchStep)), None)
    if search is None:
        return config
    keys = ("spacing_m", "area_enu_m")
    given = {key: getattr(search, key) for key in keys if getattr(search, key) is not None}
    pattern = msgspec.structs.replace(config.planner.pattern, **given)
    planner = msgspec.structs.replace(config.planner, search=search.pattern, pattern=pattern)
    return msgspec.structs.replace(config, planner=planner)


def line_of(text: str, path: str) -> int | None:
    """Return the line, from 1, of a path like `$.steps[3].limit_s`, or of what of it there is."""
    node = yaml.compose(text, Loader=yaml.SafeLoader)
    line = None
    for match in _TOKEN.finditer(path):
        key, index = match.groups()
        if isinstance(node, yaml.MappingNode) and key is not None:
            found = next((pair for pair in node.value if pair[0].value == key), None)
            if found is None:
                break
            line, node = found[0].start_mark.line, found[1]
        elif isinstance(node, yaml.SequenceNode) and index is not None:
            if int(index) >= len(node.value):
                break
            node = node.value[int(index)]
            line = node.start_mark.line
        else:
            break
    return None if line is None else line + 1


def error_at(text: str, name: str, path: str, problem: str) -> ConfigError:
    """Return the error at a path like `$.steps[3].limit_s` of a script, with its line."""
    line = line_of(text, path)
    where = name if line is None else f"{name}:{line}"
    return ConfigError(f"{where}: {path}: {problem}")


def _split_problems(message: str, name: str) -> list[Problem]:
    """Return the problems of a message, a line each, but those that only follow from others."""
    problems: list[Problem] = []
    for line in message.splitlines():
        match = _MESSAGE.match(line.removeprefix(f"{name}: "))
        if match is None:
            return []
        path, what = match["path"], match["problem"]
        is_echo = what == MISSING and any(other.startswith(path) for other, _ in problems)
        if not is_echo:  # a list whose element is wrong counts as missing then
            problems.append((path, what))
    return problems


def _with_hint(path: str, problem: str) -> str:
    """Return the problem, with a suggestion for an unknown name."""
    misspelt = _UNKNOWN_STEP.match(path)
    if misspelt is not None and problem.startswith("unknown key"):
        return _unknown("step", misspelt["name"], STEPS)
    match = _CHOICE.match(problem)
    if match is None:
        return problem
    value = match["tag"] or match["word"] or ""
    if path.endswith(".inject.kind"):
        return _unknown("fault", value, KINDS)
    if _STEP.match(path):
        if value in STEPS:
            return f"{value} needs keys: `{value}: {{...}}`"
        return _unknown("step", value, STEPS)
    return problem


def _unknown(what: str, name: str, known: Iterable[str]) -> str:
    hint = did_you_mean(name, known) or f"; known are {', '.join(known)}"
    return f"there is no {what} `{name}`{hint}"


def _problems(mission: Mission) -> Iterator[Problem]:
    """Find the problems that concern several records."""
    if len(mission.name.splitlines()) > 1:
        yield "$.name", ONE_LINE
    contradiction = inconsistency(mission.config)
    if contradiction is not None:
        path, _, problem = contradiction.partition(": ")
        yield path.replace("$", "$.companion", 1), problem.replace("$.", "$.companion.")
    ids = [mission.emitter.emitter_id, *(each.emitter_id for each in mission.emitters)]
    for number, emitter_id in enumerate(ids[1:]):
        if emitter_id in ids[: number + 1]:
            yield f"$.emitters[{number}].emitter_id", f"{emitter_id} is given twice"
    for emitter_id in mission.config.emitters.listed:
        if emitter_id not in ids:
            yield "$.companion.emitters.listed", _no_emitter(emitter_id, ids)
    yield from _step_problems(mission)
    yield from _expectation_problems(mission, ids)
    contradiction = inconsistency(flown_config(mission))
    if contradiction is not None:
        yield "$.steps", contradiction.replace("$.", "$.companion.")


def _step_problems(mission: Mission) -> Iterator[Problem]:
    searches = 0
    for number, (name, step) in enumerate(mission.named_steps):
        path = f"$.steps[{number}].{name}"
        match step:
            case WaitUntilStep():
                yield from _condition_problems(f"{path}.condition", step.condition)
            case SearchStep():
                searches += 1
                if searches > 1:
                    yield path, "a script has one search at most"
                if step.area_enu_m is not None and step.pattern != "lawnmower":
                    yield f"{path}.area_enu_m", "only a lawnmower has an area"
                if mission.config.planner.kind == "survey":
                    yield path, "the companion's planner.kind is a survey already"
                try:
                    flown_config(mission)
                except ValueError as error:
                    yield path, str(error)
            case TakeoffStep(altitude_m=float(height_m)):
                highest_m = mission.config.limits.altitude_max_m
                if height_m > highest_m:
                    limit = f"$.companion.limits.altitude_max_m ({highest_m:g} m)"
                    yield f"{path}.altitude_m", f"{height_m:g} m is above {limit}"


def _expectation_problems(mission: Mission, emitter_ids: list[int]) -> Iterator[Problem]:
    seen: set[str] = set()
    for number, expectation in enumerate(mission.expectations):
        path = f"$.expectations[{number}]"
        if expectation.name in seen:
            yield f"{path}.name", f"`{expectation.name}` is given twice"
        if len(expectation.name.splitlines()) > 1:
            yield f"{path}.name", ONE_LINE
        seen.add(expectation.name)
        yield from _one_expectation(path, expectation, emitter_ids)


def _one_expectation(
    path: str, expectation: Expectation, emitter_ids: list[int]
) -> Iterator[Problem]:
    value = getattr(expectation, expectation.kind)
    path = f"{path}.{expectation.kind}"
    if isinstance(value, str):
        yield from _condition_problems(path, value)
    if isinstance(value, TextSeen) and value.message not in (None, *numbers_by_name()):
        hint = did_you_mean(str(value.message), numbers_by_name())
        yield f"{path}.message", f"there is no message {value.message}{hint}"
    if isinstance(value, EmitterBound) and value.emitter not in (None, *emitter_ids):
        yield f"{path}.emitter", _no_emitter(value.emitter, emitter_ids)


def _no_emitter(emitter_id: int | None, known: list[int]) -> str:
    return f"there is no emitter {emitter_id}, only {', '.join(map(str, known))}"


def _condition_problems(path: str, text: str) -> Iterator[Problem]:
    try:
        parse_condition(text)
    except ConditionError as error:
        yield path, str(error)
