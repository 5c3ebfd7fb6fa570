"""What the page says of the scenario: every open point of the paper, and how it is fixed here.

Values are read from the canonical case, so that the page cannot tell another story than the code.
"""

from __future__ import annotations

from sim_link.evaluation.case import Case
from sim_link.world.environment import STUDY_SHADOW

OpenPoint = tuple[str, str, str]
"""The point, our choice, and why."""


def open_points(case: Case) -> list[OpenPoint]:
    """Every point that the paper leaves open.

    Args:
        case: The canonical one.
    """
    return [*_about_noise_and_filter(case), *_about_flight(case), *_about_tables()]


def _about_noise_and_filter(case: Case) -> list[OpenPoint]:
    channel, belief = case.channel, case.belief
    position_sigma_m, *offset_sigmas = belief.prior[1][[0, 2]].tolist()
    return [
        (
            "Bearing noise",
            f"{channel.bearing_sigma_deg:g} deg",
            "not given; with it the passive rows land near the paper's",
        ),
        (
            "NLOS draw",
            "one for range and bearing together"
            if case.nlos_draws == "joint"
            else "one each for range and bearing",
            "one path carries both",
        ),
        (
            "Exp(8.0)",
            f"mean {channel.range_bias_mean_m:g} m",
            "the tables call it the mean bias",
        ),
        ("Horizon", f"{case.steps} steps", 'the table\'s ">500"'),
        (
            "First estimate",
            "first range and bearing, inverted; "
            f"prior sigma {position_sigma_m:g} m of the position, {offset_sigmas[0]:g} m and "
            f"{belief.bearing_offset_sigma_deg:g} deg of the offsets",
            "the same for every filter",
        ),
        (
            "Thresholds",
            f"k = {belief.range_k_long:g} for ranges, {belief.bearing_k:g} for bearings",
            "the paper's sweep is centred there",
        ),
    ]


def _about_flight(case: Case) -> list[OpenPoint]:
    width_m, depth_m = case.area_m
    first_m = case.first_lane_north_m
    first_m = 0.5 * case.lane_spacing_m if first_m is None else first_m
    return [
        (
            "Lawnmower",
            f"{case.lane_spacing_m:g} m lanes over {width_m:g} x {depth_m:g} m, "
            f"the first at {first_m:g} m",
            "a lane through the target would measure an accident",
        ),
        (
            "FIM candidates",
            f"{case.fim_headings} headings at the step length ({case.step_m:g} m), and staying",
            '"candidate moves around the UAV"',
        ),
        (
            "Stopping distance of reactive crossing",
            f"{case.stop_distance_m:g} m",
            "stopping near the estimate ends learning",
        ),
    ]


def _about_tables() -> list[OpenPoint]:
    shadow = STUDY_SHADOW
    return [
        (
            "Steps to 2.5 m",
            "one more than the last step with an RMSE of at least 2.5 m",
            '"settle below"',
        ),
        (
            "Structured obstacle",
            "30 to 45 m east, 30 to 60 m north; behind it always NLOS, mean "
            f"{shadow.extra_bias_mean_m:g} m, bend {shadow.bearing_bias_sigma_deg:g} deg; "
            "elsewhere p = 0.1",
            "the paper gives no numbers",
        ),
        (
            "Sensitivity tables",
            "p at mean 8 m; mean at p = 0.7; step and k at p = 0.9",
            "read off the cells that repeat",
        ),
    ]
