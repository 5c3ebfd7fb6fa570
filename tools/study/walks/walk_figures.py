"""Recorded walks through the flying estimator: errors, states, and claims along the way.

A claim is the tracker's estimate at each tenth of the measurements of a target. A claim of
*localised* holds if the truth is within its R95. If two positions are stated, the error of the
better one is printed next to that of the best: only a walk to the side decides between them.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from companion.config.schema import load_config
from companion.domain import EstimateState, TargetEstimate
from companion.errors import ConfigError
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.replay.walk_replay import WalkRow, read_walk, with_unknown_height

PRESETS = {
    "rtt": "wifi_rtt",
    "wsr": "wifi_aoa",
    "plaza": "uwb_scaled",
    "uwb": "uwb",
}
"""Preset by how the name of a recorded walk begins."""
CLAIMS = 10
"""Claims of a target along its walk."""
CONFIGS = Path(__file__).resolve().parents[3] / "configs" / "companion"


@dataclass(frozen=True, slots=True)
class Claim:
    """Estimate of a target at one time, with the truth."""

    state: EstimateState
    error_m: float
    better_error_m: float
    """Error of the better one of the stated positions."""
    r95_m: float
    estimate: TargetEstimate | None = None

    @classmethod
    def of(cls, estimate: TargetEstimate, truth_enu_m: tuple[float, float]) -> Claim:
        """Return an estimate with the truth."""
        error_m = better_m = math.dist(estimate.position_enu_m, truth_enu_m)
        if estimate.alternative_enu_m is not None:
            better_m = min(error_m, math.dist(estimate.alternative_enu_m, truth_enu_m))
        return cls(estimate.state, error_m, better_m, estimate.r95_m, estimate)

    @property
    def is_localised(self) -> bool:
        """Return True if one position is claimed."""
        return self.state is EstimateState.LOCALISED

    @property
    def is_inside(self) -> bool:
        """Return True if the truth is within R95 of the estimate."""
        return self.error_m <= self.r95_m

    @property
    def is_stated(self) -> bool:
        """Return True if the truth is within R95 of one of the positions."""
        return self.better_error_m <= self.r95_m


@dataclass(slots=True)
class TargetClaims:
    """One target of a recorded walk."""

    walk: str
    target_id: str
    measurements: int
    along: list[Claim] = field(default_factory=list)
    final: Claim | None = None
    seconds: float = 0.0
    """Processor time of all measurements."""


def preset_of(path: Path) -> TrackerParams:
    """Return the estimation of the preset that a walk of this name is replayed with."""
    return load_config(CONFIGS / f"{name_of_preset(path)}.yaml").tracking


def name_of_preset(path: Path) -> str:
    """Return the preset for a walk of this name; raise ConfigError without one."""
    for prefix, name in PRESETS.items():
        if path.stem.startswith(prefix):
            return name
    known = ", ".join(PRESETS)
    raise ConfigError(f"{path}: its name begins with none of {known}: no preset is meant for it")


def walks_in(folder: Path) -> list[Path]:
    """Return the recorded walks of a folder; a ConfigError if there are none."""
    paths = sorted(folder.glob("*.csv"))
    if not paths:
        raise ConfigError(f"{folder}: no recorded walk (*.csv) in it")
    return paths


def targets_of(path: Path, own_sigma_m: float | None = None) -> list[list[WalkRow]]:
    """Return the rows of each target of a walk whose truth is known; see `read_walk`."""
    targets: dict[str, list[WalkRow]] = {}
    for row in read_walk(path, own_sigma_m):
        if row.truth_enu_m is not None:
            targets.setdefault(row.target_id, []).append(row)
    return list(targets.values())


def claims_of(path: Path, params: TrackerParams) -> list[TargetClaims]:
    """Return the claims of all targets of a walk whose truth is known."""
    return [replayed(path.stem, rows, params) for rows in targets_of(path)]


def replayed(walk: str, rows: Sequence[WalkRow], params: TrackerParams) -> TargetClaims:
    """Replay one target's measurements through a tracker; return its claims."""
    params = with_unknown_height(params, rows)
    tracker = TargetTracker(params, rows[0].measurement.emitter_id)
    found = TargetClaims(walk, rows[0].target_id, len(rows))
    due = {len(rows) * (index + 1) // CLAIMS for index in range(CLAIMS)}
    began_s = time.process_time()
    for count, row in enumerate(rows, 1):
        now_s = row.measurement.measured_at_s
        tracker.fuse(row.measurement, row.agent_enu_m, now_s, row.own)
        estimate = tracker.estimate(now_s) if count in due else None
        if estimate is not None and row.truth_enu_m is not None:
            found.along.append(Claim.of(estimate, row.truth_enu_m))
    found.seconds = time.process_time() - began_s
    if params.window.enabled:
        tracker.optimize(params.window.starts)
    last = rows[-1]
    estimate = tracker.estimate(last.measurement.measured_at_s)
    if estimate is not None and last.truth_enu_m is not None:
        found.final = Claim.of(estimate, last.truth_enu_m)
    return found


def quantile(values: Iterable[float], share: float) -> float:
    """Return a quantile, linear between neighbours; NaN of nothing."""
    found = list(values)
    return float(np.quantile(found, share)) if found else math.nan


def share_of(claims: Sequence[Claim], holds: Callable[[Claim], bool]) -> str:
    """Return the share of claims for which something holds, as text."""
    return f"{sum(map(holds, claims))}/{len(claims)}"


def pooled_lines(name: str, targets: Sequence[TargetClaims]) -> list[str]:
    """Return the figures of targets taken together, as lines of text."""
    finals = [target.final for target in targets if target.final is not None]
    along = [claim for target in targets for claim in target.along]
    errors, better = [c.error_m for c in finals], [c.better_error_m for c in finals]
    count = sum(target.measurements for target in targets)
    cost_ms = 1000.0 * sum(target.seconds for target in targets) / count
    lines = [
        f"{name}: {len(targets)} targets, {count} measurements, {cost_ms:.2f} ms each",
        f"  final error, m          median {quantile(errors, 0.5):6.2f}  "
        f"90 % {quantile(errors, 0.9):6.2f}",
        f"  better stated position, m  median {quantile(better, 0.5):6.2f}  "
        f"90 % {quantile(better, 0.9):6.2f}",
    ]
    for when, claims in (("final", finals), ("along the way", along)):
        for state in EstimateState:
            of_state = [claim for claim in claims if claim.state is state]
            if of_state:
                lines.append(
                    f"  {when}, {state.value}: {len(of_state)}/{len(claims)}, "
                    f"inside R95 {share_of(of_state, lambda c: c.is_inside)}, "
                    f"of a stated position {share_of(of_state, lambda c: c.is_stated)}"
                )
    return lines


def target_line(target: TargetClaims) -> str:
    """Return one target, its final claim, and its states along the way (capital: within R95)."""
    letters = "".join(
        claim.state.value[0].upper() if claim.is_stated else claim.state.value[0]
        for claim in target.along
    )
    final = target.final
    if final is None:
        return f"    {target.walk} {target.target_id}: nothing"
    return (
        f"    {target.walk[:22]:22s} {target.target_id[:12]:12s} {target.measurements:5d} "
        f"{final.state.value:10s} error {final.error_m:7.2f}  better {final.better_error_m:6.2f}  "
        f"R95 {final.r95_m:7.2f}  {letters}"
    )


def walk_lines(folder: Path) -> list[str]:
    """Return the figures of a folder's recorded walks."""
    pooled: dict[str, list[TargetClaims]] = {}
    lines: list[str] = []
    for path in walks_in(folder):
        found = claims_of(path, preset_of(path))
        lines += [target_line(target) for target in found]
        pooled.setdefault(name_of_preset(path), []).extend(found)
    for name, targets in pooled.items():
        lines += pooled_lines(name, targets)
    return lines
