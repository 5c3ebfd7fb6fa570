"""YAML text to frozen parameter records, with errors that name the file and the key.

msgspec checks types, bounds and unknown keys against the record. This module checks the rest:
repeated keys (YAML keeps the last one silently), numbers that are not finite, texts that cannot be
shown, and traps of YAML 1.1: `1e-3` without a point is text, `2:00` is 120, and `020` is 16.

msgspec stops at the first problem. Here the faulty value is removed and the rest is checked again,
so that one run names every problem of a file, one per line: a wrong key with the most similar
one, a wrong choice with the valid ones.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import yaml

from companion.errors import ConfigError, in_words, located, meant
from companion.io.files import open_file

T = TypeVar("T")
Renew = Callable[[dict[str, Any]], object]
MIN_MAGNITUDE = 1e-12
"""Smallest magnitude but 0; the square of a much smaller number is zero, its inverse infinite."""
MAX_PROBLEMS = 20
"""Largest number of lines in an error."""
MAX_BYTES = 100_000
"""Largest size of a file, nine times that of the longest one here; a larger one is another kind of
file, or an attack: a megabyte takes six seconds to read."""
MAX_MERGED = 10_000
"""Keys that merges (`<<`) of a file may copy."""
SHOWN = 20
"""Characters of a value that an error repeats."""
UNKNOWN = "unknown key; check its spelling and indentation"
UNPRINTABLE = "has characters that cannot be shown"
_UNPRINTABLE = re.compile(
    r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
)
"""Control characters, those that turn the direction of a line, and halves of a character."""

_OCTAL = re.compile(r"[-+]?0[0_]*[1-7]_*[0-7]")
"""A number in base eight that is another one in base ten."""
_PATH_PART = re.compile(r"\.(?P<key>[^.\[]+)|\[(?P<index>\d+|\.\.\.)\]")
_NAMED_KEY = re.compile(r"^(?P<key>[a-z][a-z0-9_]*(?:[.\[]\S*)?): (?P<problem>.*)$", re.DOTALL)
_LINES = "`key: value` lines"
_UNKNOWN_KEY = re.compile(r"^Object contains unknown field `(?P<key>.*)`$")


_READ_AS_OTHERS = {
    f"tag:yaml.org,2002:{kind}" for kind in ("int", "float", "bool", "null", "timestamp")
}
"""Tags of keys that YAML does not read as text."""


class _Loader(yaml.SafeLoader):
    """The safe loader, without the traps named above."""

    merged = 0
    """Number of keys that merges have copied so far."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Copy the keys that a mapping merges, as the safe loader does, up to a limit."""
        own = len(node.value)
        super().flatten_mapping(node)
        self.merged += max(0, len(node.value) - own)
        if self.merged > MAX_MERGED:
            raise yaml.constructor.ConstructorError(
                None, None, f"merges (`<<`) more than {MAX_MERGED} keys", node.start_mark
            )

    def construct_mapping(
        self, node: yaml.MappingNode, deep: bool = False
    ) -> dict[Hashable, object]:
        """Return the mapping of a node, as the safe loader does, and refuse a repeated key.

        Keys are text as written: `0012`, `1E23`, `0x1a2b` or `no` may name an emitter.
        """
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key `{key.value}` is given twice", key.start_mark
                )
            seen.add(key.value)
            if key.tag in _READ_AS_OTHERS:
                key.tag = "tag:yaml.org,2002:str"
        return super().construct_mapping(node, deep)

    def construct_number(self, node: yaml.ScalarNode) -> int | float:
        """Return the number of a node, as the safe loader does; refuse other bases and overflow."""
        problem = "is too large"
        is_whole = node.tag == "tag:yaml.org,2002:int"
        is_octal = is_whole and _OCTAL.match(node.value)
        try:
            if ":" not in node.value and not is_octal:
                make = self.construct_yaml_int if is_whole else self.construct_yaml_float
                number: int | float = make(node)
                return number
            base = "eight" if is_octal else "sixty"
            problem = f"would be read in base {base}; give one number, or a text in quotes"
        except ValueError:
            pass
        shown = node.value if len(node.value) <= SHOWN else f"{node.value[:SHOWN]}..."
        raise yaml.constructor.ConstructorError(
            None, None, f"the number `{shown}` {problem}", node.start_mark
        )


for _tag in ("int", "float"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", _Loader.construct_number)
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?[0-9][0-9_]*[eE][-+]?[0-9]+$"),
    list("-+0123456789"),
)


def load_yaml(path: Path, kind: type[T], renew: Renew | None = None) -> T:
    """Return `parse_yaml` of a UTF-8 file; raise `ConfigError` also if it cannot be read."""
    return parse_yaml(read_text(path), kind, str(path), renew)


def read_text(path: Path, max_bytes: int = MAX_BYTES) -> str:
    """Return the text of a UTF-8 file, without a byte order mark; raise `ConfigError` on others."""
    try:
        with open_file(path) as file:
            content = file.read(max_bytes + 1)
        if len(content) > max_bytes:
            raise ConfigError(f"{path}: larger than {max_bytes // 1000} kB; is it the right file?")
        text = content.decode("utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"{path}: not UTF-8 text (byte {error.start}); save it as UTF-8"
        ) from None
    return text.removeprefix("\ufeff")


def parse_yaml(text: str, kind: type[T], name: str, renew: Renew | None = None) -> T:
    """Return the record of type `kind` in YAML text called `name`; empty text is all defaults.

    `renew` gives keys of an earlier version their current names, in place. A `ConfigError` has a
    line for every problem, with the path of its key.
    """
    raw = _parse(text, name)
    if raw is None:
        raw = {}
    if not isinstance(raw, dict):
        raise ConfigError(f"{name}: $: expected {_LINES}, got {_kind_of(raw)}")
    problems = _strange_values(raw, "$", set())
    if renew is not None:
        renew(raw)
    for problem in problems:
        _take_out(raw, problem.path)
    while len(problems) < MAX_PROBLEMS:
        record = _convert(raw, kind)
        if not isinstance(record, _Problem):
            if not problems:
                return record
            break
        problems.append(record)
        if not _take_out(raw, record.path):
            break
    raise ConfigError("\n".join(f"{name}: {problem}" for problem in problems[:MAX_PROBLEMS]))


def parse_value(text: str, path: str) -> object:
    """Return the value of YAML text; a `ConfigError` begins with `path`."""
    value = _parse(text, path)
    problems = _strange_values(value, "$", set())
    if problems:
        raise ConfigError(f"{path}: {problems[0].text}")
    return value


def record_within(raw: object, kind: type[T], path: str) -> T:
    """Return the record of type `kind` in plain values; a `ValueError` begins with its path."""
    record = _convert(raw, kind)
    if isinstance(record, _Problem):
        raise ValueError(f"{path}{record.path.removeprefix('$')}: {record.text}")
    return record


@dataclass(frozen=True, slots=True)
class _Problem:
    path: str
    """Path of the value, or of the mapping that lacks one."""
    text: str

    def __str__(self) -> str:
        return f"{self.path}: {self.text}"


def _convert(raw: object, kind: type[T]) -> T | _Problem:
    try:
        return msgspec.convert(raw, kind, strict=True)
    except msgspec.ValidationError as error:
        return _located(error, raw, kind)
    except OverflowError:
        return _Problem("$", "a number is too large")
    except RecursionError:
        return _Problem("$", "nested too deeply")


def _take_out(raw: object, path: str) -> bool:
    """Delete the value at a path, or the list around it; return True if that worked."""
    owner: object = None
    last = ""
    node = raw
    for part in _PATH_PART.finditer(path):
        key = part["key"]
        if key is None:
            break
        owner, last = node, key
        if not isinstance(node, dict):
            return False
        node = node.get(key)
    if not isinstance(owner, dict) or last not in owner:
        return False
    del owner[last]
    return True


def _parse(text: str, name: str) -> object:
    try:
        return yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f" line {mark.line + 1}, column {mark.column + 1}:" if mark else ""
        problem = _one_line(error.problem or error.context or "not YAML")
        raise ConfigError(f"{name}:{where} {problem}") from None
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise ConfigError(f"{name}: line {line}: {UNPRINTABLE}") from None
    except RecursionError:
        raise ConfigError(f"{name}: nested too deeply") from None
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        raise ConfigError(f"{name}: {_one_line(str(error))}") from None


def _located(error: Exception, raw: object, kind: type) -> _Problem:
    """Return path and problem of a msgspec error, with advice."""
    path, text = located(error)
    if unknown := _UNKNOWN_KEY.match(text):
        problem = _on_unknown_key(kind, path, unknown["key"])
        return _Problem(f"{path}.{_one_line(unknown['key'])}", problem)
    named = _NAMED_KEY.match(text)  # a record's own error about one of its keys
    if named:
        return _Problem(f"{path}.{named['key']}", _one_line(named["problem"]))
    problem = _on_wrong_value(kind, path, text, _value_at(raw, path))
    return _Problem(path, _one_line(problem))


def _strange_values(value: object, path: str, seen: set[int]) -> list[_Problem]:
    """Return NaN, infinity, underflow, control characters, keys that are not text."""
    if isinstance(value, str) and _UNPRINTABLE.search(value):
        return [_Problem(path, UNPRINTABLE)]
    if isinstance(value, float) and not math.isfinite(value):
        return [_Problem(path, "must be a finite number")]
    if isinstance(value, float) and 0.0 < abs(value) < MIN_MAGNITUDE:
        return [_Problem(path, "is too close to zero to compute with; give 0 or a larger number")]
    if not isinstance(value, dict | list) or id(value) in seen:
        return []
    seen.add(id(value))
    if isinstance(value, list):
        children = [(f"{path}[{index}]", child) for index, child in enumerate(value)]
        return [p for where, child in children for p in _strange_values(child, where, seen)]
    problems = []
    for key in [key for key in value if not isinstance(key, str)]:
        problems.append(_Problem(f"{path}.{key}", "unknown key; put text keys in front of the `:`"))
        del value[key]
    for key, child in value.items():
        problems += _strange_values(child, f"{path}.{key}", seen)
    return problems


def _kind_of(value: object) -> str:
    """Return a plain value as an error shows it."""
    if isinstance(value, list | dict):
        return "a list" if isinstance(value, list) else _LINES
    if isinstance(value, str):
        return f"text: {value if len(value) <= SHOWN else f'{value[:SHOWN]}...'}"
    return "null" if value is None else str(value).lower()


def _one_line(text: str) -> str:
    return " ".join(text.split())


_PACKAGE = Path(__file__).parents[1]
CONFIG_FOLDERS = (Path("configs"), _PACKAGE.parent / "configs", _PACKAGE / "configs")
"""Folders in the working directory, checkout and installed package; the first to exist counts."""
PRESETS = ("companion", "radios")


def shipped_file(name: str) -> Path:
    """Return a file below the program's own `configs`, never the working directory's."""
    for folder in CONFIG_FOLDERS[1:]:
        if (folder / name).is_file():
            return folder / name
    raise ConfigError(f"configs/{name}: not in this installation; reinstall companion-guidance")


def preset_named(name: str) -> Path:
    """Return the file of a preset: a path, or its name below the folders of `PRESETS`."""
    path = Path(name)
    if path.is_file():
        return path
    for folder in CONFIG_FOLDERS:
        for kind in PRESETS:
            file = folder / kind / f"{name}.yaml"
            if file.is_file():
                return file
    raise ConfigError(f"preset {name}: no such file, and none of {', '.join(preset_names())}")


def preset_names() -> list[str]:
    """Return the names that `preset_named` accepts."""
    names = {
        str(file.relative_to(folder / kind).with_suffix(""))
        for folder in CONFIG_FOLDERS
        for kind in PRESETS
        for file in (folder / kind).rglob("*.yaml")
    }
    return sorted(names)


def _on_unknown_key(kind: type, path: str, key: str) -> str:
    """Return the error of a key that the record at a path lacks, with the one that was meant."""
    names = _names(_types_at(kind, path))
    plain = "".join(key.split())
    if plain in names:
        return "unknown key: it contains an unusual space character; retype it"
    if near := meant(plain, names):
        return f"unknown key{near}"
    if "[" in path:
        return UNKNOWN
    owners = [
        owner for owner, types in _records(msgspec.inspect.type_info(kind)) if key in _names(types)
    ]
    return f"unknown key; it belongs in {owners[0]}" if len(owners) == 1 else UNKNOWN


def _on_wrong_value(kind: type, path: str, problem: str, value: object) -> str:
    """Return an error in words, with the words of a choice, or with the value of another type."""
    choices = [str(word) for each in _types_at(kind, path) for word in _words_of(each)]
    if choices and problem.startswith(("Invalid enum value", "Expected `str")):
        return f"{_kind_of(value).removeprefix('text: ')} is none of {', '.join(choices)}"
    wanted, got, name = problem.partition(", got `")
    shown = f"{wanted}, got {_kind_of(value)}" if got and name.endswith("`") else problem
    return in_words(shown, _LINES)


def _value_at(raw: object, path: str) -> object:
    """Return the plain value at a path; None if there is none."""
    for part in _PATH_PART.finditer(path):
        try:
            raw = raw[part["key"] or int(part["index"])]  # type: ignore[index]
        except (KeyError, IndexError, TypeError, ValueError):
            return None
    return raw


def _types_at(kind: type, path: str) -> list[Any]:
    """Return the types that a value at a path may have."""
    types = _plain(msgspec.inspect.type_info(kind))
    for part in _PATH_PART.finditer(path):
        types = [inner for each in types for inner in _inner(each, part["key"])]
    return types


def _inner(kind: Any, key: str | None) -> list[Any]:
    """Return the types of a record's key, or of the items of a list."""
    if key is None:
        items = getattr(kind, "item_types", None) or [getattr(kind, "item_type", None)]
        return [inner for item in items if item is not None for inner in _plain(item)]
    if isinstance(kind, msgspec.inspect.DictType):
        return _plain(kind.value_type)
    found = [each for each in getattr(kind, "fields", ()) if each.encode_name == key]
    return [inner for each in found for inner in _plain(each.type)]


def _plain(kind: Any) -> list[Any]:
    """Return the members of a union, or the type itself, without annotations."""
    while isinstance(kind, msgspec.inspect.Metadata):
        kind = kind.type
    if isinstance(kind, msgspec.inspect.UnionType):
        return [inner for each in kind.types for inner in _plain(each)]
    return [kind]


def _names(types: list[Any]) -> list[str]:
    return [each.encode_name for kind in types for each in getattr(kind, "fields", ())]


def _words_of(kind: Any) -> tuple[object, ...]:
    if isinstance(kind, msgspec.inspect.LiteralType):
        return kind.values
    if isinstance(kind, msgspec.inspect.EnumType):
        return tuple(member.value for member in kind.cls)
    return ()


def _records(kind: Any, path: str = "") -> Iterator[tuple[str, list[Any]]]:
    """Yield every record below a type that is not an item of a list, with its path."""
    for record in _plain(kind):
        for each in getattr(record, "fields", ()):
            inner, key_path = _plain(each.type), f"{path}.{each.encode_name}".removeprefix(".")
            if _names(inner):
                yield key_path, inner
                yield from _records(each.type, key_path)
