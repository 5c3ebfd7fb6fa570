"""Advice on a key or a value that a record refuses: the key that was meant, the words there are."""

from __future__ import annotations

import re
from collections.abc import Iterator
from difflib import get_close_matches
from typing import Any

import msgspec

_PART = re.compile(r"\.(?P<key>[^.\[]+)|\[(?:\d+|\.\.\.)\]")
SHOWN = 20
"""Characters of a value that an error repeats."""
UNKNOWN = "unknown key; check its spelling and indentation"


def on_unknown_key(kind: type, path: str, key: str) -> str:
    """Return the error of a key that the record at a path lacks, with the one that was meant."""
    names = _names(_types_at(kind, path))
    plain = "".join(key.split())
    if plain in names:
        return "unknown key: it contains a space that is none; type it again"
    if near := get_close_matches(plain.lower(), names, n=1):
        return f"unknown key; did you mean {near[0]}?"
    if "[" in path:
        return UNKNOWN
    owners = [
        owner for owner, types in _records(msgspec.inspect.type_info(kind)) if key in _names(types)
    ]
    return f"unknown key; it belongs into {owners[0]}" if len(owners) == 1 else UNKNOWN


def on_wrong_value(kind: type, path: str, problem: str, value: object) -> str:
    """Return an error with the words that a choice has, or with the value of another type."""
    if problem.startswith("Invalid enum value"):
        words = [str(word) for each in _types_at(kind, path) for word in _words_of(each)]
        return f"{problem}; there are {', '.join(words)}" if words else problem
    if isinstance(value, str) and problem.endswith("got `str`"):
        return f"{problem}: {value if len(value) <= SHOWN else f'{value[:SHOWN]}...'}"
    return problem


def value_at(raw: object, path: str) -> object:
    """Return the plain value at a path; None if there is none."""
    for part in re.finditer(r"\.([^.\[]+)|\[(\d+)\]", path):
        try:
            raw = raw[part[1] if part[2] is None else int(part[2])]  # type: ignore[index]
        except (KeyError, IndexError, TypeError):
            return None
    return raw


def _types_at(kind: type, path: str) -> list[Any]:
    """Return the types that a value at a path may have."""
    types = _plain(msgspec.inspect.type_info(kind))
    for part in _PART.finditer(path):
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
    """Yield every record below a type that is no item of a list, with its path."""
    for record in _plain(kind):
        for each in getattr(record, "fields", ()):
            inner, key_path = _plain(each.type), f"{path}.{each.encode_name}".removeprefix(".")
            if _names(inner):
                yield key_path, inner
                yield from _records(each.type, key_path)
