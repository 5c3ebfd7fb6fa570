"""Share of walks in which a cell's constant delay ends as `localised` at a wrong position.

    python tools/campaign/cell_offsets.py [--walks 40] [--offsets 0-25]

A vehicle flies a lawnmower about a phone 50 to 400 m away; srsRAN 4G's RACH lines, a constant of so
many steps added, go through the shipped preset: without calibration, and with `offset_steps`. Each
line: offset, walks that are localised, of those outside R95, worst error in R95s.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from companion.config.radios import RadioConfig, radio_setup
from companion.config.schema import CompanionConfig, load_config
from companion.domain import EstimateState
from companion.entry import ignore_broken_pipe
from companion.estimation.tracker import TargetTracker
from companion.link.radio_stage import RadioStage
from sim_link.emulators.cellular import LTE_STEP_M, rach_line

PRESET = Path(__file__).resolve().parents[2] / "configs" / "radios" / "srsran_4g.yaml"
ATTACHES, PERIOD_S, SPEED_MPS = 120, 2.0, 5.0
LEG_M, HEIGHT_M = 240.0, 40.0
DETOUR_M = 20.0
"""Mean of the exponential excess, and the preset's multipath sigma."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """End of a walk."""

    is_localised: bool
    error_m: float
    r95_m: float

    @property
    def is_outside(self) -> bool:
        """Return True if localised with the phone outside R95."""
        return self.is_localised and self.error_m > self.r95_m


def preset_with(offset_steps: int | None) -> CompanionConfig:
    """Return the shipped preset, calibrated to a number of steps; None: uncalibrated."""
    config = load_config(PRESET)
    (radio,) = config.radios
    if offset_steps is not None:
        options = {**radio.options, "offset_steps": offset_steps}
        radio = msgspec.structs.replace(radio, options=options)
    return msgspec.structs.replace(config, radios=(radio,))


def place_at(time_s: float) -> tuple[float, float, float]:
    """Return the position on legs to the east and back, 60 m apart."""
    along_m = SPEED_MPS * time_s
    leg, rest_m = divmod(along_m, LEG_M)
    east_m = rest_m if int(leg) % 2 == 0 else LEG_M - rest_m
    return (east_m - 0.5 * LEG_M, 60.0 * leg - 150.0, HEIGHT_M)


def walk(config: CompanionConfig, offset_steps: int, seed: int) -> Outcome:
    """Run one walk, the radio's lines through decoder, stage and tracker."""
    rng = np.random.default_rng((seed, 4))
    away_m, towards_rad = rng.uniform(50.0, 400.0), rng.uniform(-math.pi, math.pi)
    phone = (away_m * math.cos(towards_rad), away_m * math.sin(towards_rad), 0.0)
    radio: RadioConfig = config.radios[0]
    stage = RadioStage(radio_setup(radio, "preset"))
    tracker = TargetTracker(config.tracking, 1)
    for number in range(ATTACHES):
        now_s = PERIOD_S * number
        place = place_at(now_s)
        range_m = math.dist(place, phone) + rng.exponential(DETOUR_M) * (rng.random() < 0.5)
        line = rach_line(number, 7, int(range_m // LTE_STEP_M) + offset_steps, 0x46)
        for measurement in stage.receive(f"{line}\n".encode(), now_s):
            tracker.fuse(measurement, place, now_s)
    if config.tracking.window.enabled:
        tracker.optimize(config.tracking.window.starts)
    estimate = tracker.estimate(PERIOD_S * ATTACHES)
    if estimate is None:
        return Outcome(False, math.inf, math.inf)
    error_m = math.dist(estimate.position_enu_m, phone[:2])
    return Outcome(estimate.state is EstimateState.LOCALISED, error_m, estimate.r95_m)


def line_of(offset: int, outcomes: list[Outcome]) -> str:
    """Return the figures of some walks."""
    localised = [each for each in outcomes if each.is_localised]
    worst = max((each.error_m / each.r95_m for each in localised), default=0.0)
    outside = sum(each.is_outside for each in localised)
    return f"{offset:3d} steps: {len(localised):3d} localised, {outside} outside, worst {worst:.2f}"


def main() -> None:
    """Print all figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--walks", type=int, default=40)
    parser.add_argument("--offsets", default="0-25", metavar="FROM-TO")
    arguments = parser.parse_args()
    low, high = map(int, arguments.offsets.split("-"))
    for title, is_calibrated in (("as shipped", False), ("calibrated", True)):
        print(title)
        for offset in range(low, high + 1):
            config = preset_with(offset if is_calibrated else None)
            print(line_of(offset, [walk(config, offset, s) for s in range(arguments.walks)]))


if __name__ == "__main__":
    ignore_broken_pipe()
    main()
