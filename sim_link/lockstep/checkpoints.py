"""Checkpoints of a companion in lockstep: as a process keeps them, in memory, on invented time.

What is kept are the bytes that would be on disk, so that a test can damage them between a kill and
the next start.
"""

from __future__ import annotations

from companion.io.state.checkpoints import (
    Checkpoint,
    CheckpointError,
    Moment,
    StoredCheckpoints,
    decode_checkpoint,
    encode_checkpoint,
)
from companion.process.persistence import RestartKeeper, digests_of
from sim_link.lockstep.flight import Flight
from sim_link.lockstep.observer import Observer

MAX_AGE_S = 600.0


class MemoryStore:
    """Two generations of bytes."""

    def __init__(self) -> None:
        self.slots: dict[int, bytes] = {}

    def load(self) -> StoredCheckpoints:
        """What is there."""
        whole, problems = [], []
        for number, data in self.slots.items():
            try:
                whole.append(decode_checkpoint(data))
            except CheckpointError as error:
                problems.append(f"slot {number}: {error}")
        newest = max(whole, key=lambda checkpoint: checkpoint.sequence, default=None)
        return StoredCheckpoints(bool(self.slots), newest, tuple(problems))

    def save(self, checkpoint: Checkpoint) -> None:
        """Keep a checkpoint in place of the older one."""
        self.slots[checkpoint.sequence % 2] = encode_checkpoint(checkpoint)

    def discard(self) -> None:
        """Forget both."""
        self.slots.clear()

    def close(self, timeout_s: float) -> None:
        """Everything is kept already."""
        del timeout_s


class FlightClock:
    """A flight's time as a shell's clock."""

    speed = 1.0

    def __init__(self, flight: Flight) -> None:
        self._flight = flight

    def now_s(self) -> float:
        """Invented seconds."""
        return self._flight.now_s


class Checkpointing(Observer):
    """An observer that gives a flight's companion what a process has beside it.

    Args:
        flight: Its companion is the first to be kept; each that is started later takes up what
            the one before left.
        max_age_s: A memory older than this means nothing.
    """

    def __init__(self, flight: Flight, max_age_s: float = MAX_AGE_S) -> None:
        self.store = MemoryStore()
        self._flight = flight
        self._max_age_s = max_age_s
        self._begin()
        flight.observers.append(self)

    def _begin(self) -> None:
        flight = self._flight
        self._keeper = RestartKeeper(
            flight.companion,
            self.store,
            digests_of(flight.config),
            FlightClock(flight),
            self._max_age_s,
            moment=lambda: Moment(flight.now_s, "lockstep", flight.now_s),
        )

    def companion_started(self, now_s: float) -> None:
        """Another process: it looks back."""
        del now_s
        self._begin()

    def companion_ended(self, now_s: float) -> None:
        """In order or not."""
        del now_s
        self._keeper.close(0.0)

    def ticked(self, now_s: float) -> None:
        """The chores of a wake-up."""
        self._keeper.run(now_s)
