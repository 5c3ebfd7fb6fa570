"""Chooses a preset's keys from recorded walks, leaving out each file in turn.

For every file the variant with the smallest median plus 90th percentile of the final errors on the
*other* files of its preset is chosen, among those with at least 94 % of the claims of
*localised* hold there, or else the most; its figures on the left-out file are those to expect on a
walk that it was not tuned to.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from companion.estimation.tracker_params import TrackerParams
from tools.console import done_by
from tools.study.walks.walk_figures import (
    TargetClaims,
    claims_of,
    name_of_preset,
    pooled_lines,
    preset_of,
    quantile,
    walks_in,
)

TRIED: dict[str, dict[str, tuple[float, ...]]] = {
    "wifi_rtt": {
        "range_offset_m": (0.8, 1.1, 1.4),
        "range_k_long": (0.3, 0.6),
        "place_range_sigma_m": (0.4, 0.7),
    },
    "wifi_aoa": {
        "bearing_k": (0.3, 0.5, 1.0),
        "bearing_offset_sigma_deg": (4.0, 7.0, 12.0),
        "place_bearing_sigma_deg": (3.0, 5.0),
    },
}
"""Values of `estimation.filter` by preset; every combination is tried."""

HELD_SHARE = 0.94
"""Share of claims of *localised* that must be inside R95."""
NOTHING_M = 1e9
"""Error of a target without an estimate."""

Variant = tuple[float, ...]
"""A value of each key, in the order of `TRIED`."""


@dataclass(frozen=True, slots=True)
class Job:
    """One walk through one variant of its preset."""

    path: Path
    variant: Variant


def variants_of(preset: str) -> Iterator[Variant]:
    """Yield every combination of the tried values of a preset."""
    return itertools.product(*TRIED[preset].values())


def varied(params: TrackerParams, preset: str, variant: Variant) -> TrackerParams:
    """Return a preset's estimation with other values of the tried keys."""
    changed = dict(zip(TRIED[preset], variant, strict=True))
    chosen = msgspec.structs.replace(params.filter, **changed)
    return msgspec.structs.replace(params, filter=chosen)


def flown(job: Job) -> list[TargetClaims]:
    """Return the claims of a job."""
    return claims_of(job.path, varied(preset_of(job.path), name_of_preset(job.path), job.variant))


def jobs_in(folder: Path) -> list[Job]:
    """Return all jobs for choosing among the variants, for presets with at least two files."""
    files: dict[str, list[Path]] = {}
    for path in walks_in(folder):
        files.setdefault(name_of_preset(path), []).append(path)
    return [
        Job(path, variant)
        for preset, own in files.items()
        if preset in TRIED and len(own) > 1
        for path in own
        for variant in variants_of(preset)
    ]


def score(targets: Sequence[TargetClaims]) -> float:
    """Return median plus 90th percentile of the final errors, metres."""
    errors = [NOTHING_M if t.final is None else t.final.error_m for t in targets]
    return quantile(errors, 0.5) + quantile(errors, 0.9)


def rank(targets: Sequence[TargetClaims]) -> tuple[float, float]:
    """Return how far the claims stay below `HELD_SHARE`, and the `score`; the smallest is best."""
    claims = [claim for t in targets for claim in t.along if claim.is_localised]
    held = sum(claim.is_inside for claim in claims) / len(claims) if claims else 1.0
    return max(0.0, HELD_SHARE - held), score(targets)


def left_out_lines(folder: Path, jobs: int = 1) -> list[str]:
    """Return the variant that the other files choose for each file, and its pooled figures."""
    work = jobs_in(folder)
    return choices(dict(zip(work, done_by(flown, work, jobs), strict=True)))


def choices(results: Mapping[Job, list[TargetClaims]]) -> list[str]:
    """Return the lines of `left_out_lines` from the results of all jobs."""
    lines: list[str] = []
    pooled: dict[str, list[TargetClaims]] = {}
    for left_out in dict.fromkeys(job.path for job in results):
        preset = name_of_preset(left_out)
        others = {j.path for j in results if name_of_preset(j.path) == preset} - {left_out}

        def on_the_others(variant: Variant, others: set[Path] = others) -> tuple[float, float]:
            """Return the rank of a variant on the files that are not left out."""
            return rank([t for path in others for t in results[Job(path, variant)]])

        best = min(variants_of(preset), key=on_the_others)
        values = ", ".join(
            f"{key} {value:g}" for key, value in zip(TRIED[preset], best, strict=True)
        )
        lines.append(f"{left_out.stem}: the other files choose {values}")
        pooled.setdefault(preset, []).extend(results[Job(left_out, best)])
    for preset, targets in pooled.items():
        lines += pooled_lines(f"{preset}, each file left out in turn", targets)
    return lines
