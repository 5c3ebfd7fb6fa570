"""Cases that differ from the canonical one as the cells of the paper's tables do."""

from __future__ import annotations

import msgspec

from sim_link.world.environment import ChannelParams
from tools.study.case import PAPER_BELIEF, Case


def canonical_case(
    *,
    range_sigma_m: float = 1.5,
    p_nlos: float = 0.9,
    mean_bias_m: float = 8.0,
    range_k: float = 1.5,  # k_rtt
) -> Case:
    """The canonical scenario with what the paper's tables vary; the filter knows the noise."""
    channel = ChannelParams(
        range_sigma_m=range_sigma_m, p_nlos=p_nlos, range_bias_mean_m=mean_bias_m
    )
    belief = msgspec.structs.replace(
        PAPER_BELIEF, range_sigma_m=range_sigma_m, range_k_long=range_k
    )
    return Case(channel=channel, belief=belief)
