"""Which invariants a kind of flight can be judged by, and why not by the others."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from sim_link.monitor.beliefs import HonestCovariance, OnlyProvedFrames, Repeatable
from sim_link.monitor.control import KeepsStreaming, OnlyWithAuthority, SilentWithoutTick
from sim_link.monitor.frames import Bounded, KnownFrames
from sim_link.monitor.motions import FreshState, WithinEnvelope
from sim_link.monitor.places import PlacesOnly, SetpointsInside

TITLES = {
    kind.name: kind.title
    for kind in (
        SetpointsInside,
        WithinEnvelope,
        OnlyWithAuthority,
        PlacesOnly,
        FreshState,
        KnownFrames,
        KeepsStreaming,
        SilentWithoutTick,
        HonestCovariance,
        OnlyProvedFrames,
        Bounded,
        Repeatable,
    )
}
"""Every invariant by its name."""


@dataclass(frozen=True, slots=True)
class Scope:
    """What is judged, and what is not."""

    judged: Mapping[str, str]
    """How, by the invariant's name; empty: without any restriction."""
    unjudged: Mapping[str, str]
    """Why not, by the invariant's name."""

    def unjudged_of(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Those among some that are not judged."""
        return tuple(name for name in names if name not in self.judged)


NOTHING = Scope({}, dict.fromkeys(TITLES, "nobody watched"))
_TWICE = "needs a second flight with the same seed"
LOCKSTEP = Scope(
    judged={
        **dict.fromkeys(("I1", "I2", "I3", "I4", "I5", "I6", "I7", "I8", "I9"), ""),
        "I11": "frames and lines of the log, not queues",
    },
    unjudged={
        "I10": "needs the companion's whole state around every frame; fault campaigns compare it",
        "I12": _TWICE,
    },
)
"""A mission in memory: every frame, every step of the true vehicle and every control tick."""
WIRE = Scope(
    judged={
        "I1": "setpoints and the ways to them, not the true vehicle",
        "I2": "",
        "I3": "whoever gave the mode back, a person or the autopilot by itself",
        "I4": "every setpoint is a place; where it leads is not flown on",
        "I5": "",
        "I6": "",
        "I7": "at the receiver, with the companion's log",
        "I9": "as the companion's log has it",
        "I11": "frames and lines of the log, not queues",
    },
    unjudged={
        "I8": "the control tick does not show outside of the process",
        "I10": "needs the companion's whole state around every frame",
        "I12": "real clocks never repeat",
    },
)
"""Real processes: the frames of both directions as they pass the hub, and the companion's log."""
