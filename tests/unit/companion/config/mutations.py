"""Configuration files as hurried people and broken editors leave them behind; seeded."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

import msgspec
import yaml

from companion.config.schema import CompanionConfig

PRESETS = Path(__file__).parents[4] / "configs" / "companion"

STRANGE_VALUES: tuple[object, ...] = (
    *(float("nan"), float("inf"), float("-inf"), 0, -1, -0.0, 1e308, 1e-308, 2**63, 10**400),
    *(True, None, "", "5 m", "1,5", "ten", "0x10", "1_000", "\x00", "\u202e", "~", "é" * 300),
    *([], {}, [[]], [[0, 0]], [None], {"a": 1}, [[0, 0], [1, 1], [2, 2]], [1.0] * 50),
)
TYPOS = ("x", " ", "_", "m", "\t", "-")
BAD_LINES = ("\t- a", "}", "[", ": :", "<<<<<<< HEAD", "%YAML 9", "&a *a", "!!python/name:os", "? ")


def mutants(seed: int, count: int) -> Iterator[str]:
    """Texts of files, most of them wrong."""
    rng = random.Random(seed)
    presets = [path.read_text() for path in sorted(PRESETS.glob("*.yaml"))]
    for number in range(count):
        if number % 5 == 0:
            yield _damaged(rng.choice(presets[1:]), rng)
        else:
            yield _edited(rng)


def _edited(rng: random.Random) -> str:
    """A few keys of the schema with values of any kind, some keys misspelt."""
    raw: dict[str, object] = {}
    for _ in range(rng.choice((1, 1, 2, 3))):
        path, default = rng.choice(LEAVES)
        node = raw
        for key in path[:-1]:
            inner = node.setdefault(key, {})
            assert isinstance(inner, dict)
            node = inner
        name = path[-1]
        if rng.random() < 0.15:
            at = rng.randrange(len(name) + 1)
            name = name[:at] + rng.choice(TYPOS) + name[at:]
        node[name] = _other_value(default, rng)
    return yaml.safe_dump(raw, allow_unicode=True)


def _other_value(default: object, rng: random.Random) -> object:
    if isinstance(default, float | int) and rng.random() < 0.4:
        return default * rng.choice((-1.0, 0.0, 1e-3, 0.5, 2.0, 100.0, 1e6, 57.3))
    return rng.choice(STRANGE_VALUES)


def _damaged(text: str, rng: random.Random) -> str:
    """The text of a preset after an accident."""
    lines = text.splitlines(keepends=True)
    at = rng.randrange(len(lines))
    match rng.randrange(6):
        case 0:
            return text[: rng.randrange(len(text))]
        case 1:
            lines.insert(at, rng.choice(BAD_LINES) + "\n")
        case 2:
            lines.insert(at, lines[rng.randrange(len(lines))])
        case 3:
            lines[at] = " " + lines[at]
        case 4:
            index = rng.randrange(len(text))
            return text[:index] + chr(rng.randrange(32, 0x250)) + text[index + 1 :]
        case 5:
            del lines[at]
    return "".join(lines)


def _leaves(record: object, path: tuple[str, ...] = ()) -> list[tuple[tuple[str, ...], object]]:
    if not isinstance(record, msgspec.Struct):
        return [(path, record)]
    found = []
    for name, key in zip(record.__struct_fields__, record.__struct_encode_fields__, strict=True):
        found += _leaves(getattr(record, name), (*path, key))
    return found


LEAVES = _leaves(CompanionConfig())
