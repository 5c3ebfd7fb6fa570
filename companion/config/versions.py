"""The version of the configuration's schema, and the migration of earlier files.

The number goes up when a key is renamed, moved, removed or changes its meaning; an added key does
not change it. A file without a version is of the first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from companion.errors import ConfigError

SCHEMA_VERSION = 2
KEY = "schema_version"


@dataclass(frozen=True, slots=True)
class Gone:
    """A key without a successor."""

    advice: str
    """The advice to an operator whose file sets the key."""
    default: object = None
    """The former default: a copy of default.yaml may have it, and changes nothing by it."""


@dataclass(frozen=True, slots=True)
class Migration:
    """Changes of the keys from one version to the next; keys are paths with dots."""

    to: int
    moved: Mapping[str, str] = field(default_factory=dict)
    """Earlier path to present one; the value is kept."""
    gone: Mapping[str, Gone] = field(default_factory=dict)
    """Earlier path to the remedy; a file that has another value there is refused."""


MIGRATIONS: tuple[Migration, ...] = (
    Migration(
        2,
        gone={
            "estimation.adaptation": Gone(
                "delete it: noise is no longer learnt by EM, R95 follows the innovations as before"
            ),
            "planner.reactive_crossing": Gone(
                "delete it: the planner flies in the studies only, latched_crossing in flight",
                {"step_m": 5.0, "crossing_distance_m": 20.0, "stop_distance_m": 0.0},
            ),
        },
    ),
)
"""Migrations in the order of their versions; the last one leads to `SCHEMA_VERSION`."""


def renew(
    raw: dict[str, Any],
    name: str,
    present: int = SCHEMA_VERSION,
    migrations: Sequence[Migration] = MIGRATIONS,
) -> None:
    """Bring plain values of the file `name` to the present schema, in place.

    Raises `ConfigError` for an unknown version, for removed keys, and for a value that is given
    under its earlier and its present name.
    """
    version = _version(raw, name, present)
    for migration in migrations:
        if migration.to > version:
            _apply(migration, raw, name)
    raw[KEY] = present


def _version(raw: Mapping[str, Any], name: str, present: int) -> int:
    version = raw.get(KEY, 1)
    if isinstance(version, bool) or not isinstance(version, int) or version < 1:
        raise ConfigError(f"{name}: $.{KEY}: expected a whole number from 1 to {present}")
    if version > present:
        raise ConfigError(
            f"{name}: $.{KEY}: the file is of schema {version}, and this companion reads up to "
            f"{present}; install a newer companion-guidance"
        )
    return version


def _apply(migration: Migration, raw: dict[str, Any], name: str) -> None:
    for path, gone in migration.gone.items():
        owner = _owner(raw, path)
        if owner is None:
            continue
        if owner.pop(path.rpartition(".")[2]) != gone.default:
            raise ConfigError(f"{name}: $.{path}: gone since schema {migration.to}; {gone.advice}")
    for earlier, path in migration.moved.items():
        owner = _owner(raw, earlier)
        if owner is None:
            continue
        if _owner(raw, path) is not None:
            raise ConfigError(f"{name}: $.{earlier}: is $.{path} now, and both are given; keep one")
        value = owner.pop(earlier.rpartition(".")[2])
        *sections, key = path.split(".")
        place = raw
        for section in sections:
            place = place.setdefault(section, {})
            if not isinstance(place, dict):
                raise ConfigError(f"{name}: $.{path}: `{section}` must be a section")
        place[key] = value


def _owner(raw: Mapping[str, Any], path: str) -> dict[str, Any] | None:
    """Return the mapping that has the last key of a path, or None."""
    *sections, key = path.split(".")
    place: Any = raw
    for section in sections:
        place = place.get(section) if isinstance(place, dict) else None
    return place if isinstance(place, dict) and key in place else None
