"""The version of the configuration's schema, and the migration of files of schema 1.

The number goes up when a key is renamed, moved, removed or changes its meaning; an added key does
not change it. A file without a version has the first one. Schema 2 is not released yet: until then
its step takes further changes, afterwards the next schema gets a step of its own in `renew`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from companion.errors import ConfigError

SCHEMA_VERSION = 2
KEY = "schema_version"


@dataclass(frozen=True, slots=True)
class Removed:
    """A key without a successor."""

    advice: str = ""
    """The advice to an operator whose file sets the key; empty: the value is fixed."""
    default: object = None
    """Former default; a file that sets it is read, and the key is ignored."""


_SETTINGS_OF = {
    "lawnmower": {"area_enu_m": None, "lane_heading_deg": None, "spacing_m": 20.0},
    "expanding_square": {
        "datum_enu_m": None,
        "heading_deg": 0.0,
        "radius_m": 100.0,
        "spacing_m": 20.0,
    },
    "sector": {"datum_enu_m": None, "heading_deg": 0.0, "radius_m": 60.0, "spacing_m": 20.0},
}
"""Keys of the patterns of schema 1 that `planner.pattern` has, and their defaults."""
_PATTERNS = tuple(_SETTINGS_OF)


def _merge_to_2(raw: dict[str, Any]) -> list[str]:
    """Move the single emitter, the checkpoint's switch and the pattern to their new keys."""
    emitter_id = raw.pop("emitter_id", None)
    if emitter_id is not None:
        queue = raw.setdefault("emitters", {})
        if isinstance(queue, dict) and not queue.get("listed"):
            queue["listed"] = [emitter_id]
    process = raw.get("process")
    if isinstance(process, dict) and process.pop("checkpoint", True) is False:
        process["resume_max_age_s"] = None
    planner = raw.get("planner")
    return _merge_patterns(planner) if isinstance(planner, dict) else []


def _merge_patterns(planner: dict[str, Any]) -> list[str]:
    if planner.get("kind") in _PATTERNS:
        planner["search"], planner["kind"] = planner["kind"], "survey"
    dropped = []
    for pattern in _PATTERNS:
        section = planner.get(pattern)
        if not isinstance(section, dict):
            continue
        is_flown = pattern == planner.get("search")
        for key, default in _SETTINGS_OF[pattern].items():
            if key not in section:
                continue
            value = section.pop(key)
            if is_flown and value != default:
                planner.setdefault("pattern", {})[key.removeprefix("lane_")] = value
            elif not is_flown and value != default:
                dropped.append(f"planner.{pattern}.{key}")
        if not section:
            del planner[pattern]
    return dropped


_OF_RADIO = "set {} in the radio's `settings` instead"
REMOVED_KEYS: Mapping[str, Removed] = {
    "emitters.most": Removed("delete it: the limit is 8, or the number of listed ids", 8),
    "mission.coast_drift_mps": Removed(default=1.0),
    "mission.coast_sigma_max_m": Removed(default=30.0),
    "estimation.adaptation": Removed(
        "delete it: noise is no longer learnt by EM, R95 follows the innovations as before"
    ),
    "planner.reactive_crossing": Removed(
        "delete it: that planner is for studies only; flights use latched_crossing",
        {"step_m": 5.0, "crossing_distance_m": 20.0, "stop_distance_m": 0.0},
    ),
    "estimation.initial_inflation": Removed(default=4.0),
    "estimation.adapt_inflation": Removed(default=True),
    "estimation.range_gross_k": Removed("set filter.range_k_short instead", 6.0),
    "estimation.acceptance.max_range_m": Removed(_OF_RADIO.format("range_max_m"), 2000.0),
    "estimation.acceptance.max_age_s": Removed(_OF_RADIO.format("max_age_s"), 1.0),
    "estimation.hypotheses.nearest_m": Removed(default=3.0),
    "estimation.window.enabled": Removed(default=True),
    "estimation.window.size": Removed(default=512),
    "estimation.window.every": Removed(default=25),
    "estimation.window.starts": Removed(default=12),
    "estimation.filter.elevation_sigma_deg": Removed(_OF_RADIO.format("elevation_sigma_deg"), 5.0),
    "estimation.filter.use_elevation": Removed(
        "delete it, and set elevation_sigma_deg: 90 in the radio's `settings`", True
    ),
    "estimation.filter.range_scale_min": Removed(
        "delete it: range_scale_max bounds the scale to both sides"
    ),
    "estimation.filter.stamp_lag_s": Removed(_OF_RADIO.format("lag_s"), 0.0),
    "estimation.filter.near_target_terms": Removed(default=True),
    "planner.latched_crossing.arrival_radius_m": Removed(default=1.5),
    "planner.latched_crossing.reaim_distance_m": Removed(default=3.0),
    "planner.latched_crossing.overshoot_sigmas": Removed(default=3.0),
    **dict.fromkeys(
        (f"planner.{each}.arrival_radius_m" for each in _PATTERNS), Removed(default=1.5)
    ),
    "planner.lawnmower.start_corner": Removed(
        "delete it: a lawnmower begins at the nearest corner", "nearest"
    ),
    "planner.fim.step_m": Removed(default=5.0),
    "planner.fim.headings": Removed(default=16),
    "planner.fim.range_offset_sigma_m": Removed(default=5.0),
    "planner.fim.bearing_offset_sigma_deg": Removed(default=5.0),
    "planner.fim.near_target_terms": Removed(default=True),
    "limits.step_m": Removed(default=8.0),
    "limits.navigation_sigma_m": Removed(
        "delete it: raise fence_margin_m and altitude_min_m instead", 0.3
    ),
    "link.lossy_rate_hz": Removed("delete it: it is 50; rate_hz is the rate elsewhere", 50.0),
    "link.lossy_share": Removed(default=0.2),
}
"""Keys of schema 1 absent from schema 2, by path; only the former default is accepted."""


def renew(raw: dict[str, Any], name: str) -> list[str]:
    """Migrate plain values of the file `name` to the current schema, in place.

    Returns the paths of removed keys that had their default. Raises `ConfigError` for an unknown
    version and for other values of removed keys.
    """
    version = raw.get(KEY, 1)
    if isinstance(version, bool) or not isinstance(version, int) or version < 1:
        raise ConfigError(f"{name}: $.{KEY}: expected a whole number from 1 to {SCHEMA_VERSION}")
    if version > SCHEMA_VERSION:
        raise ConfigError(
            f"{name}: $.{KEY}: the file is of schema {version}, and this companion reads up to "
            f"{SCHEMA_VERSION}; install a newer companion-guidance"
        )
    raw[KEY] = SCHEMA_VERSION
    return [*_merge_to_2(raw), *_drop(raw, name)] if version < 2 else []


def _drop(raw: dict[str, Any], name: str) -> list[str]:
    """Delete removed keys that had their default, and sections that become empty."""
    dropped = [path for path in REMOVED_KEYS if is_in(raw, path)]
    for path in dropped:
        gone = REMOVED_KEYS[path]
        if _pop(raw, path) != gone.default:
            advice = gone.advice or f"delete it: it is fixed at {gone.default}"
            raise ConfigError(f"{name}: $.{path}: removed in schema 2; {advice}")
    return dropped


def _pop(raw: dict[str, Any], path: str) -> object:
    """Remove a value, and the sections that it leaves empty."""
    key, _, rest = path.partition(".")
    if not rest:
        return raw.pop(key)
    value = _pop(raw[key], rest)
    if not raw[key]:
        del raw[key]
    return value


def is_in(raw: object, path: str) -> bool:
    """Return True if plain values have a key, given as a path with dots."""
    for part in path.split("."):
        if not isinstance(raw, dict) or part not in raw:
            return False
        raw = raw[part]
    return True
