"""What can be wrong in frames that arrive: the radio's measurements and the vehicle's reports."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from companion.domain import Positive
from sim_link.faults.record import FaultRecord, Length, Share

RangingField = Literal["range", "bearing", "both"]


class ContentFault(FaultRecord, frozen=True):
    """Something in the frames themselves; no matter over which link they come."""


class StreamMute(ContentFault, frozen=True, tag="stream_mute"):
    """One message of the vehicle does not arrive."""

    message: str = "LOCAL_POSITION_NED"
    """Its MAVLink name."""


class TelemetryNonsense(ContentFault, frozen=True, tag="telemetry_nonsense"):
    """Some of the vehicle's reports carry a sentinel, no number or an absurd one in a field."""

    share: Share = 0.3


class RangingFault(ContentFault, frozen=True):
    """Something with the radio's measurements."""


class RangingDropout(RangingFault, frozen=True, tag="ranging_dropout"):
    """Range, bearing or both are missing."""

    missing: RangingField = "both"


class RangingFreeze(RangingFault, frozen=True, tag="ranging_freeze"):
    """The radio repeats its last measurement with fresh stamps."""


class RangingWrongUnit(RangingFault, frozen=True, tag="ranging_wrong_unit"):
    """Range or bearing comes in another unit."""

    of: RangingField = "range"
    factor: Positive = 100.0


class RangingOutliers(RangingFault, frozen=True, tag="ranging_outliers"):
    """Some measurements are grossly wrong: too long or too short, and a bearing from anywhere."""

    share: Share = 0.3
    """Of measurements outside of bursts, with which one begins."""
    excess_m: Length = 40.0
    """Mean of what is added to the range; negative: ranges are too short, as no reflection is."""
    is_bearing_hit: bool = True
    burst: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 1
    """So many in a row."""


class RangingStale(RangingFault, frozen=True, tag="ranging_stale"):
    """Measurements arrive late, with the stamp of when they were made."""

    age_s: Positive = 0.7


class RangingOutOfOrder(RangingFault, frozen=True, tag="ranging_out_of_order"):
    """Measurements overtake each other."""

    window_s: Positive = 0.8


class RangingSecondEmitter(RangingFault, frozen=True, tag="ranging_second_emitter"):
    """Another emitter answers too; with the same id, it poses as ours."""

    east_m: Length = 0.0
    north_m: Length = 60.0
    emitter_id: Annotated[int, msgspec.Meta(ge=0, le=65_535)] | None = None
    """None: it uses ours."""


class RangingNan(RangingFault, frozen=True, tag="ranging_nan"):
    """Some measurements are no numbers, infinite, negative or absurd."""

    share: Share = 0.5
