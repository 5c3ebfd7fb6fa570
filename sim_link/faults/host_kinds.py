"""What can happen to the companion's process, and who may attack it."""

from __future__ import annotations

from companion.domain import NonNegative, Positive
from sim_link.faults.record import FaultRecord, Rate


class ProcessFault(FaultRecord, frozen=True):
    """Something with the companion's process or its host."""


class CompanionKilled(ProcessFault, frozen=True, tag="companion_killed"):
    """The process is killed, and started anew after a while; event."""

    down_s: NonNegative = 1.0


class CompanionStalled(ProcessFault, frozen=True, tag="companion_stalled"):
    """The process gets no time (SIGSTOP, a starved host)."""

    duration_s: Positive = 1.0


class CompanionTerminated(ProcessFault, frozen=True, tag="companion_terminated"):
    """The process is asked to end (SIGTERM); event."""


class SecurityFault(FaultRecord, frozen=True):
    """Somebody on the link who should not be there."""

    rate_hz: Rate = 50.0


class ForgedFrames(SecurityFault, frozen=True, tag="forged_frames"):
    """Frames in the vehicle's name, signed with a wrong key where the link is signed."""


class ReplayedFrames(SecurityFault, frozen=True, tag="replayed_frames"):
    """Frames that the vehicle sent before, bit by bit."""


class UnsignedFrames(SecurityFault, frozen=True, tag="unsigned_frames"):
    """Frames in the vehicle's name without any signature."""


class ForeignFrames(SecurityFault, frozen=True, tag="foreign_frames"):
    """Frames of another vehicle on the same link, with an id of its own."""
