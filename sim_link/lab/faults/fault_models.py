"""Every fault as a frozen record: its kind, beginning and duration.

The same records drive the link in memory, the UDP proxy and the injector; a YAML file names one by
its `kind`: `{kind: link_loss, share: 0.3, start_s: 20, duration_s: 5}`. Times are seconds since the
schedule began. Faults of the vehicle itself are in `sim_link.autopilot.incidents`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias, Union

import msgspec

from companion.domain import FlightMode, NonNegative, Params, Positive
from sim_link.autopilot.incidents import FaultRecord, OtherVehicle, VehicleFault, kinds_of
from sim_link.world.point_mass import Share

Count = Annotated[int, msgspec.Meta(ge=1, le=1000)]
Length = Annotated[float, msgspec.Meta(ge=-1e5, le=1e5)]
Rate = Annotated[float, msgspec.Meta(gt=0.0, le=100_000.0)]


Direction = Literal["both", "to_companion", "to_vehicle"]


class LinkFault(FaultRecord, frozen=True):
    """Fault of the link, in one direction or both."""

    direction: Direction = "both"


class LinkLoss(LinkFault, frozen=True, tag="link_loss"):
    """Frames are lost independently."""

    share: Share = 0.3


class LinkBursts(LinkFault, frozen=True, tag="link_bursts"):
    """Gilbert-Elliott: the link changes between a good and a bad state, by time, not by frame."""

    mean_good_s: Positive = 2.0
    mean_bad_s: Positive = 0.2
    loss_good: Share = 0.0
    loss_bad: Share = 1.0


class LinkBlackout(LinkFault, frozen=True, tag="link_blackout"):
    """Nothing arrives; in one direction only, that is a one-way link."""


class LinkDelay(LinkFault, frozen=True, tag="link_delay"):
    """Delay of every frame."""

    delay_s: NonNegative = 0.1


class LinkJitter(LinkFault, frozen=True, tag="link_jitter"):
    """Some frames are late by a random time, so that others overtake them."""

    jitter_s: Positive = 0.2
    share: Share = 1.0


class LinkDuplicates(LinkFault, frozen=True, tag="link_duplicates"):
    """Some frames arrive several times."""

    share: Share = 0.1
    copies: Count = 1
    """Number of copies besides the frame itself."""
    spread_s: NonNegative = 0.1
    """Copies arrive up to this much later."""


class LinkBitFlips(LinkFault, frozen=True, tag="link_bit_flips"):
    """Some frames arrive with flipped bits."""

    share: Share = 0.1
    bits: Count = 1


class LinkTruncation(LinkFault, frozen=True, tag="link_truncation"):
    """Some frames lose their end."""

    share: Share = 0.1


class LinkGarbage(LinkFault, frozen=True, tag="link_garbage"):
    """Some frames are preceded by bytes that are not a frame, in the same datagram."""

    share: Share = 0.1
    most_bytes: Count = 40


class LinkRateCap(LinkFault, frozen=True, tag="link_rate_cap"):
    """Slow link with a queue; datagrams that do not fit are lost."""

    bits_per_s: Positive = 57_600.0
    queue_bytes: Annotated[int, msgspec.Meta(ge=1, le=10_000_000)] = 4096


class LinkHold(LinkFault, frozen=True, tag="link_hold"):
    """Nothing arrives until the fault is over; then everything at once."""


RangingField = Literal["range", "bearing", "both"]


class ContentFault(FaultRecord, frozen=True):
    """Fault in the frames themselves, on any link."""


class StreamMute(ContentFault, frozen=True, tag="stream_mute"):
    """One message of the vehicle does not arrive."""

    message: str = "LOCAL_POSITION_NED"


class TelemetryNonsense(ContentFault, frozen=True, tag="telemetry_nonsense"):
    """Some of the vehicle's reports have a sentinel, NaN or an absurd number in a field."""

    share: Share = 0.3


class RangingDropout(ContentFault, frozen=True, tag="ranging_dropout"):
    """Range, bearing or both are missing."""

    missing: RangingField = "both"


class RangingFreeze(ContentFault, frozen=True, tag="ranging_freeze"):
    """The radio repeats its last measurement with fresh stamps."""


class RangingWrongUnit(ContentFault, frozen=True, tag="ranging_wrong_unit"):
    """Range or bearing is reported in another unit."""

    of: RangingField = "range"
    factor: Positive = 100.0


class RangingOutliers(ContentFault, frozen=True, tag="ranging_outliers"):
    """Some measurements are grossly wrong: too long or too short, and a bearing from anywhere."""

    share: Share = 0.3
    """Share of the measurements outside of bursts that begin one."""
    excess_m: Length = 40.0
    """Mean addition to the range; negative: too short, which no reflection causes."""
    is_bearing_hit: bool = True
    burst: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 1


class RangingStale(ContentFault, frozen=True, tag="ranging_stale"):
    """Measurements arrive late, with the stamp of when they were made."""

    age_s: Positive = 0.7


class RangingOutOfOrder(ContentFault, frozen=True, tag="ranging_out_of_order"):
    """Ranging measurements in another order than measured."""

    window_s: Positive = 0.8


class RangingSecondEmitter(ContentFault, frozen=True, tag="ranging_second_emitter"):
    """Another emitter answers too; with the same id, it poses as ours."""

    east_m: Length = 0.0
    north_m: Length = 60.0
    emitter_id: Annotated[int, msgspec.Meta(ge=0, le=65_535)] | None = None
    """Id of the other emitter; None if it uses ours."""


class RangingNan(ContentFault, frozen=True, tag="ranging_nan"):
    """Some measurements are NaN, infinite, negative or absurd."""

    share: Share = 0.5


class ProcessFault(FaultRecord, frozen=True):
    """Fault of the companion's process or its host."""


class CompanionKilled(ProcessFault, frozen=True, tag="companion_killed"):
    """The process is killed and restarted after a while; event."""

    down_s: NonNegative = 1.0


class CompanionStalled(ProcessFault, frozen=True, tag="companion_stalled"):
    """The process is suspended (SIGSTOP, a starved host)."""

    duration_s: Positive = 1.0


class CompanionTerminated(ProcessFault, frozen=True, tag="companion_terminated"):
    """The process is asked to end (SIGTERM); event."""


class SecurityFault(FaultRecord, frozen=True):
    """An intruder on the link."""

    rate_hz: Rate = 50.0


class ForgedFrames(SecurityFault, frozen=True, tag="forged_frames"):
    """Frames in the vehicle's name, signed with a wrong key where the link is signed."""


class ReplayedFrames(SecurityFault, frozen=True, tag="replayed_frames"):
    """Frames that the vehicle sent before, bit by bit."""


class UnsignedFrames(SecurityFault, frozen=True, tag="unsigned_frames"):
    """Frames in the vehicle's name without any signature."""


class ForeignFrames(SecurityFault, frozen=True, tag="foreign_frames"):
    """Frames of another vehicle with its own id on the same link."""


class ModeFlap(VehicleFault, frozen=True, tag="mode_flap"):
    """The mode switch flips back and forth."""

    mode: FlightMode = FlightMode.HOLD
    period_s: Positive = 0.5
    duration_s: Positive = 4.0


class Disarm(VehicleFault, frozen=True, tag="disarm"):
    """The motors stop in the air; event."""


class SecondSender(VehicleFault, frozen=True, tag="second_sender"):
    """A second source sends setpoints to the vehicle."""

    rate_hz: Rate = 10.0
    east_m: Length = 20.0
    north_m: Length = 20.0
    up_m: Length = 15.0
    duration_s: Positive = 3.0


GROUPS = (LinkFault, ContentFault, VehicleFault, ProcessFault, SecurityFault, OtherVehicle)
KINDS: dict[str, type[FaultRecord]] = {
    str(kind.__struct_config__.tag): kind for base in GROUPS for kind in kinds_of(base)
}
"""Every fault by the name that a file gives it."""
if TYPE_CHECKING:
    Fault: TypeAlias = FaultRecord
else:
    Fault = Union[tuple(KINDS.values())]  # noqa: UP007  not written out


class Schedule(Params, frozen=True):
    """Faults, each with its start and duration, in seconds since the schedule began."""

    faults: tuple[Fault, ...] = ()


def fault_from(fields: dict[str, object]) -> Fault:
    """Convert a mapping to the fault of its `kind`; raise `msgspec.ValidationError` if invalid."""
    fault: Fault = msgspec.convert(fields, Fault)
    return fault
