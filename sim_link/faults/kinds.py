"""Every fault as a frozen record: what goes wrong, when, and for how long.

The same records drive the link in memory, the UDP proxy and the injector; a YAML file names one by
its `kind`: `{kind: link_loss, share: 0.3, start_s: 20, duration_s: 5}`. Times are seconds since the
schedule began. A fault without an end lasts until the schedule is over; an event (a reboot, a mode
switch) happens at its start, and its duration means nothing.
"""

from __future__ import annotations

from typing import get_args

from sim_link.faults.content_kinds import (
    ContentFault as ContentFault,
)
from sim_link.faults.content_kinds import (
    RangingDropout as RangingDropout,
)
from sim_link.faults.content_kinds import (
    RangingFreeze as RangingFreeze,
)
from sim_link.faults.content_kinds import (
    RangingNan as RangingNan,
)
from sim_link.faults.content_kinds import (
    RangingOutliers as RangingOutliers,
)
from sim_link.faults.content_kinds import (
    RangingOutOfOrder as RangingOutOfOrder,
)
from sim_link.faults.content_kinds import (
    RangingSecondEmitter as RangingSecondEmitter,
)
from sim_link.faults.content_kinds import (
    RangingStale as RangingStale,
)
from sim_link.faults.content_kinds import (
    RangingWrongUnit as RangingWrongUnit,
)
from sim_link.faults.content_kinds import (
    StreamMute as StreamMute,
)
from sim_link.faults.content_kinds import (
    TelemetryNonsense as TelemetryNonsense,
)
from sim_link.faults.host_kinds import (
    CompanionKilled as CompanionKilled,
)
from sim_link.faults.host_kinds import (
    CompanionStalled as CompanionStalled,
)
from sim_link.faults.host_kinds import (
    CompanionTerminated as CompanionTerminated,
)
from sim_link.faults.host_kinds import (
    ForeignFrames as ForeignFrames,
)
from sim_link.faults.host_kinds import (
    ForgedFrames as ForgedFrames,
)
from sim_link.faults.host_kinds import (
    ProcessFault as ProcessFault,
)
from sim_link.faults.host_kinds import (
    ReplayedFrames as ReplayedFrames,
)
from sim_link.faults.host_kinds import (
    SecurityFault as SecurityFault,
)
from sim_link.faults.host_kinds import (
    UnsignedFrames as UnsignedFrames,
)
from sim_link.faults.link_kinds import (
    LinkBitFlips as LinkBitFlips,
)
from sim_link.faults.link_kinds import (
    LinkBlackout as LinkBlackout,
)
from sim_link.faults.link_kinds import (
    LinkBursts as LinkBursts,
)
from sim_link.faults.link_kinds import (
    LinkDelay as LinkDelay,
)
from sim_link.faults.link_kinds import (
    LinkDuplicates as LinkDuplicates,
)
from sim_link.faults.link_kinds import (
    LinkFault as LinkFault,
)
from sim_link.faults.link_kinds import (
    LinkGarbage as LinkGarbage,
)
from sim_link.faults.link_kinds import (
    LinkHold as LinkHold,
)
from sim_link.faults.link_kinds import (
    LinkJitter as LinkJitter,
)
from sim_link.faults.link_kinds import (
    LinkLoss as LinkLoss,
)
from sim_link.faults.link_kinds import (
    LinkRateCap as LinkRateCap,
)
from sim_link.faults.link_kinds import (
    LinkTruncation as LinkTruncation,
)
from sim_link.faults.record import (
    FaultRecord as FaultRecord,
)
from sim_link.faults.vehicle_kinds import (
    Battery as Battery,
)
from sim_link.faults.vehicle_kinds import (
    Disarm as Disarm,
)
from sim_link.faults.vehicle_kinds import (
    EkfJump as EkfJump,
)
from sim_link.faults.vehicle_kinds import (
    EkfPoor as EkfPoor,
)
from sim_link.faults.vehicle_kinds import (
    Failsafe as Failsafe,
)
from sim_link.faults.vehicle_kinds import (
    GpsLoss as GpsLoss,
)
from sim_link.faults.vehicle_kinds import (
    ModeFlap as ModeFlap,
)
from sim_link.faults.vehicle_kinds import (
    OriginShift as OriginShift,
)
from sim_link.faults.vehicle_kinds import (
    PilotMode as PilotMode,
)
from sim_link.faults.vehicle_kinds import (
    PilotSticks as PilotSticks,
)
from sim_link.faults.vehicle_kinds import (
    SecondSender as SecondSender,
)
from sim_link.faults.vehicle_kinds import (
    VehicleFault as VehicleFault,
)
from sim_link.faults.vehicle_kinds import (
    VehicleReboot as VehicleReboot,
)
from sim_link.faults.vehicle_kinds import (
    Wind as Wind,
)

Fault = (
    LinkLoss
    | LinkBursts
    | LinkBlackout
    | LinkDelay
    | LinkJitter
    | LinkDuplicates
    | LinkBitFlips
    | LinkTruncation
    | LinkGarbage
    | LinkRateCap
    | LinkHold
    | StreamMute
    | RangingDropout
    | RangingFreeze
    | RangingWrongUnit
    | RangingOutliers
    | RangingStale
    | RangingOutOfOrder
    | RangingSecondEmitter
    | RangingNan
    | VehicleReboot
    | EkfJump
    | EkfPoor
    | GpsLoss
    | Wind
    | Battery
    | OriginShift
    | PilotMode
    | PilotSticks
    | ModeFlap
    | Failsafe
    | Disarm
    | SecondSender
    | TelemetryNonsense
    | CompanionKilled
    | CompanionStalled
    | CompanionTerminated
    | ForgedFrames
    | ReplayedFrames
    | UnsignedFrames
    | ForeignFrames
)
"""Any fault, told apart by `kind` in a file."""

KINDS: dict[str, type[FaultRecord]] = {
    str(kind.__struct_config__.tag): kind for kind in get_args(Fault)
}
"""Every fault by the name that a file gives it."""
