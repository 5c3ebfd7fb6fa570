"""YAML text to frozen parameter records, with errors that name the file and the place.

msgspec checks types, bounds and unknown keys against the record. Three things it does not see are
checked here: keys given twice (YAML keeps the last one silently), numbers that are not finite, and
`1e-3` without a point, which YAML 1.1 reads as text.
"""

from __future__ import annotations

import math
import re
from collections.abc import Hashable
from pathlib import Path
from typing import TypeVar

import msgspec
import yaml

from companion.errors import ConfigError

T = TypeVar("T")

_MSGSPEC_PATH = re.compile(r"^(?P<problem>.*) - at `(?P<path>\$.*)`$", re.DOTALL)
_UNKNOWN_KEY = re.compile(r"^Object contains unknown field `(?P<key>.*)`$")
_MISSING_KEY = re.compile(r"^Object missing required field `(?P<key>.*)`$")


class _Loader(yaml.SafeLoader):
    """The safe loader that also refuses a key given twice and reads `1e-3` as a number."""

    def construct_mapping(
        self, node: yaml.MappingNode, deep: bool = False
    ) -> dict[Hashable, object]:
        """The mapping of a node, as the safe loader makes it.

        Raises:
            ConstructorError: A key is given twice.
        """
        seen: set[tuple[str, str]] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue
            name = (key.tag, key.value)
            if name in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key `{key.value}` is given twice", key.start_mark
                )
            seen.add(name)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?[0-9][0-9_]*[eE][-+]?[0-9]+$"),
    list("-+0123456789"),
)


def load_yaml(path: Path, kind: type[T]) -> T:
    """The record of type `kind` in a YAML file; an empty file is all defaults.

    Args:
        path: The file, UTF-8.
        kind: A frozen msgspec Struct.

    Raises:
        ConfigError: The file cannot be read or does not hold a `kind`; one line says where.
    """
    try:
        text = path.read_bytes().decode("utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"{path}: not UTF-8 text (byte {error.start}); save it as UTF-8"
        ) from None
    return parse_yaml(text.removeprefix("\ufeff"), kind, str(path))


def parse_yaml(text: str, kind: type[T], name: str) -> T:
    """The record of type `kind` in YAML text; empty text is all defaults.

    Args:
        text: One YAML document.
        kind: A frozen msgspec Struct.
        name: What to call the text in errors, usually the file's path.

    Raises:
        ConfigError: The text does not hold a `kind`; one line says where.
    """
    raw = _parse(text, name)
    if raw is None:
        raw = {}
    if not isinstance(raw, dict):
        raise ConfigError(f"{name}: $: expected `key: value` lines, got {_kind_of(raw)}")
    path = _non_finite_path(raw, "$", set())
    if path is not None:
        raise ConfigError(f"{name}: {path}: must be a finite number")
    try:
        return msgspec.convert(raw, kind, strict=True)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{name}: {_located(str(error))}") from None
    except OverflowError:
        raise ConfigError(f"{name}: a number is too large") from None


def _parse(text: str, name: str) -> object:
    try:
        return yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f" line {mark.line + 1}, column {mark.column + 1}:" if mark else ""
        problem = _one_line(error.problem or error.context or "not YAML")
        raise ConfigError(f"{name}:{where} {problem}") from None
    except RecursionError:
        raise ConfigError(f"{name}: nested too deeply") from None
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        raise ConfigError(f"{name}: {_one_line(str(error))}") from None


def _located(problem: str) -> str:
    """`$.path: what is wrong`, from msgspec's `What is wrong - at `$.path``."""
    path = "$"
    match = _MSGSPEC_PATH.match(problem)
    if match:
        problem, path = match["problem"], match["path"]
    unknown, missing = _UNKNOWN_KEY.match(problem), _MISSING_KEY.match(problem)
    if unknown:
        return f"{path}.{unknown['key']}: unknown key; check its spelling and indentation"
    if missing:
        return f"{path}.{missing['key']}: required key is missing"
    return f"{path}: {_one_line(problem)}"


def _non_finite_path(value: object, path: str, seen: set[int]) -> str | None:
    """Where the first NaN or infinity is, or None; shared (aliased) nodes are visited once."""
    if isinstance(value, float):
        return None if math.isfinite(value) else path
    if not isinstance(value, dict | list) or id(value) in seen:
        return None
    seen.add(id(value))
    children = (
        [(f"{path}.{key}", child) for key, child in value.items()]
        if isinstance(value, dict)
        else [(f"{path}[{index}]", child) for index, child in enumerate(value)]
    )
    found = (_non_finite_path(child, where, seen) for where, child in children)
    return next((where for where in found if where is not None), None)


def _kind_of(value: object) -> str:
    if isinstance(value, list):
        return "a list"
    return "text" if isinstance(value, str) else f"`{value}`"


def _one_line(text: str) -> str:
    return " ".join(text.split())
