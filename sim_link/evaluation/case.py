"""One cell of a study: the scene, the true channel, what the filter believes, and the flight.

The defaults are the paper's canonical scenario ("Simulation Setup"), and the choices below where
the paper leaves something open:

    bearing noise            sigma_theta = 2 deg
    NLOS                     one draw per step decides for range and bearing together
    Exp(8.0)                 mean 8 m
    horizon                  500 steps, a measurement each, the first one at the start
    first estimate           the first range and bearing, inverted; offsets zero;
                             P0 = diag(30 m, 30 m, 5 m, 5 deg)^2; or a uniform draw over the area
    thresholds               k_rtt = k_aoa = 1.5
    FIM candidates           16 headings at the step length, and staying
    lawnmower                5 m lanes over the whole area, the first at y = 2.5 m
    eps_stop                 0
    plane                    sensor and target at one height, the sensor's place known exactly
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from companion.domain import NonNegative, Params, Point, Positive
from companion.estimation.filters.target_filter import FilterParams
from companion.planning.crossing import LatchedCrossingParams
from companion.planning.fim import HEADINGS
from sim_link.world.environment import STUDY_SHADOW, ChannelParams, ObstacleParams, ShadowParams

FirstEstimate = Literal["measured", "uniform"]
Offsets = Literal["fixed", "prior"]
NlosDraws = Literal["joint", "separate"]

PAPER_BELIEF = FilterParams(own_position_sigma_m=0.0)
"""What every filter believes in the canonical scenario."""


class Case(Params, frozen=True):
    """One cell of a study."""

    area_m: tuple[Positive, Positive] = (100.0, 100.0)
    """Width and depth, from the origin to the east and north."""
    start_enu_m: Point = (10.0, 10.0)
    target_enu_m: Point = (50.0, 50.0)
    channel: ChannelParams = ChannelParams()
    """The truth, outside of shadows."""
    nlos_draws: NlosDraws = "joint"
    """Whether one draw decides that both range and bearing are obstructed, or one each."""
    obstacles: tuple[ObstacleParams, ...] = ()
    """What blocks the radio, not the flight."""
    shadow: ShadowParams = STUDY_SHADOW
    """The truth behind them."""
    belief: FilterParams = PAPER_BELIEF
    """What the filter takes for the truth."""
    steps: Annotated[int, msgspec.Meta(ge=1)] = 500
    """Measurements of a run."""
    step_m: Positive = 5.0
    """Flown between two measurements. Paper: eta."""
    first_estimate: FirstEstimate = "measured"
    """The first measurement inverted, or a draw over the area that it then corrects."""
    offsets: Offsets = "fixed"
    """Those of the channel, or a draw from the filter's priors for each run."""
    lane_spacing_m: Positive = 5.0
    first_lane_north_m: NonNegative | None = None
    """None: half a spacing inside the area."""
    crossing_distance_m: Positive = 20.0
    """Of reactive crossing. Paper: l."""
    stop_distance_m: NonNegative = 0.0
    """Of reactive crossing. Paper: eps_stop."""
    latched: LatchedCrossingParams = LatchedCrossingParams()
    fim_headings: Annotated[int, msgspec.Meta(ge=3, le=360)] = HEADINGS

    def __post_init__(self) -> None:
        """Refuse what the compiled walk does not do."""
        if self.belief.process_noise_m_per_sqrt_s > 0.0:
            raise ValueError("belief.process_noise_m_per_sqrt_s must be 0: the target lies still")
        if self.belief.target_height_m != 0.0 or self.belief.target_height_sigma_m > 0.0:
            raise ValueError("belief.target_height_m must be 0 and known: studies are plane")
        if self.obstacles and self.nlos_draws == "separate":
            raise ValueError("nlos_draws must be joint among obstacles: a shadow takes the path")


def canonical_case(
    *,
    range_sigma_m: float = 1.5,
    p_nlos: float = 0.9,
    mean_bias_m: float = 8.0,
    range_k: float = 1.5,
) -> Case:
    """The canonical scenario with what the paper's tables vary; the filter knows the noise.

    Args:
        range_sigma_m: Thermal noise of ranges, of the channel and in the filter.
        p_nlos: Share of measurements on an obstructed path.
        mean_bias_m: Mean NLOS bias of a range.
        range_k: Threshold of ranges, in sigma. Paper: k_rtt.
    """
    channel = ChannelParams(
        range_sigma_m=range_sigma_m, p_nlos=p_nlos, range_bias_mean_m=mean_bias_m
    )
    belief = msgspec.structs.replace(
        PAPER_BELIEF, range_sigma_m=range_sigma_m, range_k_long=range_k
    )
    return Case(channel=channel, belief=belief)
