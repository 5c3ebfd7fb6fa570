"""Compares the tracker with estimators of other projects on recorded walks.

Every estimator is configured with the walk's preset. For each set: error, R95, share of targets
inside the radii of 50, 80, 95 and 99 %, R95 over the 95 % quantile of the errors (1 is ideal; with
its 95 % bootstrap interval over targets), energy score (metres; lower is better) and processor time
a measurement. Exit code 2: bad input.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from companion.domain import TargetEstimate
from companion.entry import ignore_broken_pipe
from companion.errors import CompanionError
from companion.geometry.coordinates import wrap_pi
from companion.io.files import check_writable, write_json_atomic
from companion.kernel import Matrix
from companion.replay.walk_replay import WalkRow
from tools.console import OneLineParser, non_negative, positive, shown
from tools.study.walks import walk_figures

LEVELS = (0.5, 0.8, 0.95, 0.99)
NOTHING_M = 1e3
"""Error of a target without an estimate."""
RESAMPLES = 2000
"""Bootstrap resamples of an interval."""
OURS = "tracker"
MISSING = "compare: GTSAM and Stone-Soup are missing: pip install 'companion-guidance[compare]'"


@dataclass(frozen=True, slots=True)
class Score:
    """One estimator's answer for one target."""

    estimator: str
    preset: str
    walk: str
    target_id: str
    measurements: int
    error_m: float
    r95_m: float
    is_inside: tuple[bool, ...]
    """True within the radius of each of `LEVELS`."""
    energy_m: float
    time_ms: float
    """Processor time a measurement."""


def score_of(
    samples: Matrix, truth: tuple[float, float], r95_m: float | None, mean: Sequence[float] | None
) -> tuple[float, float, tuple[bool, ...], float]:
    """Return error, R95, inside or not at each level, and energy score of samples (n, 2).

    Args:
        r95_m: Stated R95, by which the other radii are scaled; None: of the samples.
        mean: Stated position; None: of the samples.
    """
    centre = samples.mean(axis=0) if mean is None else np.asarray(mean)
    radii = np.quantile(np.hypot(*(samples - centre).T), LEVELS)
    if r95_m is not None:
        radii *= r95_m / radii[2]
    error_m = math.dist(centre, truth)
    far = np.hypot(*(samples - np.asarray(truth)).T).mean()
    half = len(samples) // 2
    spread = np.hypot(*(samples[:half] - samples[half : 2 * half]).T).mean()
    inside = tuple(bool(error_m <= radius) for radius in radii)
    return error_m, float(radii[2]), inside, float(far - 0.5 * spread)


def samples_of(estimate: TargetEstimate, rng: np.random.Generator) -> Matrix:
    """Return samples (2000, 2) of an estimate, from its covariance scaled to its R95."""
    drawn = rng.multivariate_normal((0.0, 0.0), np.array(estimate.covariance_m2), 2000)
    scale = estimate.r95_m / float(np.quantile(np.hypot(*drawn.T), 0.95))
    samples: Matrix = np.asarray(estimate.position_enu_m) + scale * drawn
    return samples


def scores_of(path: Path, rows: Sequence[WalkRow], seed: int) -> list[Score]:
    """Return the score of every estimator for one target of a walk."""
    from tools.study.walks.rival_estimators import RIVALS, Batch

    truth, params = rows[0].truth_enu_m, walk_figures.preset_of(path)
    assert truth is not None
    about = (walk_figures.name_of_preset(path), path.stem, rows[0].target_id, len(rows))
    batch = Batch.of(rows, params.filter)

    def result_of(name: str) -> tuple[float, float, tuple[bool, ...], float]:
        """Return the score of one estimator."""
        rng = np.random.default_rng(seed)
        if name != OURS:
            return score_of(RIVALS[name](batch, rng), truth, None, None)
        final = walk_figures.replayed(path.stem, rows, params).final
        if final is None or final.estimate is None:
            return NOTHING_M, NOTHING_M, (True,) * len(LEVELS), NOTHING_M
        stated = final.estimate
        return score_of(samples_of(stated, rng), truth, stated.r95_m, stated.position_enu_m)

    found: list[Score] = []
    for name in (OURS, *RIVALS):
        began_s = time.process_time()
        result = result_of(name)
        spent_ms = 1000.0 * (time.process_time() - began_s) / len(rows)
        found.append(Score(name, *about, *result, spent_ms))
    return found


def median_ratio(errors_m: Matrix, radii_m: Matrix) -> Matrix:
    """Return median R95 over the 95 % quantile of the errors, of sets of targets (..., n)."""
    ratio: Matrix = np.median(radii_m, axis=-1) / np.quantile(errors_m, 0.95, axis=-1)
    return ratio


def ratio_text(errors: Sequence[float], radii: Sequence[float]) -> str:
    """Return R95 over the 95 % quantile of the errors, with its bootstrap interval."""
    errors_m, radii_m = np.array(errors), np.array(radii)
    chosen = np.random.default_rng(1).integers(len(errors_m), size=(RESAMPLES, len(errors_m)))
    low, high = np.quantile(median_ratio(errors_m[chosen], radii_m[chosen]), (0.025, 0.975))
    return f"{median_ratio(errors_m, radii_m):.2f} ({low:.1f} to {high:.1f})"


def shifted(rows: Sequence[WalkRow], count: int, rng: np.random.Generator) -> list[list[WalkRow]]:
    """Return `count` walks along the same path, with the recorded errors shifted along it.

    Errors of ranges are about the line that fits them by distance, so that offset and scale stay,
    and errors of bearings about the true ones. They keep their order, and begin at a random
    measurement (a circular bootstrap).
    """
    truth = np.asarray(rows[0].truth_enu_m)
    to_target = truth - np.array([row.agent_enu_m[:2] for row in rows])
    distance_m = np.hypot(*to_target.T)
    measured = np.array(
        [(row.measurement.range_m, row.measurement.bearing_enu_rad) for row in rows], dtype=float
    )
    is_measured = np.isfinite(measured)
    expected = np.stack([distance_m, np.arctan2(to_target[:, 1], to_target[:, 0])], axis=1)
    if is_measured[:, 0].any():
        has_range = is_measured[:, 0]
        line = np.polynomial.Polynomial.fit(distance_m[has_range], measured[has_range, 0], 1)
        expected[:, 0] = line(distance_m)
    walks = []
    for _ in range(count):
        values = measured.copy()
        for column, seen in enumerate(is_measured.T):
            if seen.any():
                errors = measured[seen, column] - expected[seen, column]
                errors = np.roll(errors, int(rng.integers(len(errors))))
                values[seen, column] = expected[seen, column] + errors
        walks.append([_with_values(row, *pair) for row, pair in zip(rows, values, strict=True)])
    return walks


def _with_values(row: WalkRow, range_m: float, bearing_rad: float) -> WalkRow:
    """Return a row with another range and bearing; NaN: not measured."""
    measurement = replace(
        row.measurement,
        range_m=None if math.isnan(range_m) else max(float(range_m), 0.0),
        bearing_enu_rad=None if math.isnan(bearing_rad) else wrap_pi(bearing_rad),
    )
    return replace(row, measurement=measurement)


def table(scores: Sequence[Score]) -> str:
    """Return a Markdown table: a row for each preset and estimator."""
    head = "| preset | estimator | targets | error: median, 90 %, m | R95: median, m | "
    head += "inside 50 / 80 / 95 / 99 % | R95 over 95 % error | energy score, m | ms |"
    lines = [head, "|---|---|---|---|---|---|---|---|---|"]
    for preset, name in dict.fromkeys((s.preset, s.estimator) for s in scores):
        of = [s for s in scores if (s.preset, s.estimator) == (preset, name)]
        errors, radii = [s.error_m for s in of], [s.r95_m for s in of]
        shares = [100.0 * sum(s.is_inside[level] for s in of) / len(of) for level in range(4)]
        cells = (
            preset,
            name,
            str(len(of)),
            f"{walk_figures.quantile(errors, 0.5):.2f}, {walk_figures.quantile(errors, 0.9):.2f}",
            f"{walk_figures.quantile(radii, 0.5):.2f}",
            " / ".join(f"{share:.0f}" for share in shares),
            ratio_text(errors, radii),
            f"{np.mean([s.energy_m for s in of]):.2f}",
            f"{np.mean([s.time_ms for s in of]):.2f}",
        )
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def plot(scores: Sequence[Score], path: Path) -> None:
    """Draw error against R95 of every target, a panel for each estimator."""
    from tools.study.reporting.plots import panels_of

    names = list(dict.fromkeys(s.estimator for s in scores))
    figure, (panels,) = panels_of(len(names), len(names), 3.2, 3.25, sharex=True, sharey=True)
    ends = [min(s.r95_m for s in scores), max(s.r95_m for s in scores)]
    for panel, name in zip(panels, names, strict=True):
        for preset in dict.fromkeys(s.preset for s in scores):
            of = [s for s in scores if (s.preset, s.estimator) == (preset, name)]
            errors, radii = [s.error_m for s in of], [s.r95_m for s in of]
            panel.loglog(radii, errors, "o", alpha=0.7, label=preset)
        panel.loglog(ends, ends, color="0.5", linewidth=1.0)
        panel.set_title(name)
        panel.set_xlabel("stated R95, m")
    panels[0].set_ylabel("error, m (above the line: outside R95)")
    panels[0].legend(frameon=False)
    figure.savefig(path, dpi=120)


def main(argv: Sequence[str] | None = None) -> int:
    """Compare all estimators on a folder's walks; return the exit code."""
    parser = OneLineParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="recorded walks, *.csv")
    parser.add_argument("--only", action="append", default=[], metavar="WALK", help="this walk")
    parser.add_argument(
        "--own-sigma", type=float, metavar="M", help="standard deviation of the agent's positions"
    )
    parser.add_argument(
        "--shifts",
        type=positive,
        metavar="N",
        help="instead of each target, N walks with its errors shifted along its path",
    )
    parser.add_argument("--seed", type=non_negative, default=1, metavar="N")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there")
    parser.add_argument("--plot", type=Path, metavar="PNG", help="draw error against R95 there")
    arguments = parser.parse_args(argv)
    try:
        scores = compared(arguments)
        print(table(scores))
        if arguments.json is not None:
            write_json_atomic(arguments.json, scores)
        if arguments.plot is not None:
            plot(scores, arguments.plot)
    except CompanionError as error:
        parser.error(str(error))
    except ModuleNotFoundError as error:
        if error.name not in ("gtsam", "stonesoup"):
            raise
        parser.error(MISSING)
    return 0


def compared(arguments: argparse.Namespace) -> list[Score]:
    """Return the scores of all targets; progress goes to stderr."""
    for path in (arguments.json, arguments.plot):
        if path is not None:
            check_writable(path)
    walks = [
        p
        for p in walk_figures.walks_in(arguments.folder)
        if not arguments.only or p.stem in arguments.only
    ]
    rng = np.random.default_rng(arguments.seed)
    tasks = [
        (path, walk)
        for path in walks
        for rows in walk_figures.targets_of(path, arguments.own_sigma)
        for walk in (shifted(rows, arguments.shifts, rng) if arguments.shifts else [rows])
    ]
    scores: list[Score] = []
    with shown(sum(len(rows) for _, rows in tasks), sys.stderr) as done:
        for path, rows in tasks:
            scores += scores_of(path, rows, arguments.seed)
            done(len(rows))
    return scores


if __name__ == "__main__":
    ignore_broken_pipe()
    sys.exit(main())
