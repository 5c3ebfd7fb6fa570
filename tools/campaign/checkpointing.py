"""In-memory checkpoints of a lockstep flight, as the bytes that would be on disk.

They can be damaged between a kill and the next start.
"""

from __future__ import annotations

from companion.io import checkpoints
from companion.persistence import RestartKeeper
from sim_link.lab.lockstep import Flight
from sim_link.lab.observer import Observer

MAX_AGE_S = 600.0


class MemoryStore:
    """Two generations of bytes."""

    def __init__(self) -> None:
        self.slots: dict[int, bytes] = {}

    def load(self) -> checkpoints.StoredCheckpoints:
        """Load the stored checkpoints."""
        whole, problems = [], []
        for number, data in self.slots.items():
            try:
                whole.append(checkpoints.decode_checkpoint(data))
            except checkpoints.CheckpointError as error:
                problems.append(f"slot {number}: {error}")
        newest = max(whole, key=lambda checkpoint: checkpoint.sequence, default=None)
        return checkpoints.StoredCheckpoints(bool(self.slots), newest, tuple(problems))

    def save(self, checkpoint: checkpoints.Checkpoint) -> None:
        """Keep a checkpoint in place of the older one."""
        self.slots[checkpoint.sequence % 2] = checkpoints.encode_checkpoint(checkpoint)

    def discard(self) -> None:
        """Forget both."""
        self.slots.clear()

    def close(self, timeout_s: float) -> None:
        """Do nothing: everything is kept already."""
        del timeout_s


class Checkpointing(Observer):
    """Observer that gives a flight's companion the services of its process, the clock among them.

    Each companion started resumes the previous one's checkpoint, unless it is too old.
    """

    speed = 1.0

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
            flight.config,
            self,
            self._max_age_s,
            moment=lambda: checkpoints.Moment(flight.now_s, "lockstep", flight.now_s),
        )

    def now_s(self) -> float:
        """Return the invented time, s."""
        return self._flight.now_s

    def companion_started(self, now_s: float) -> None:
        """Handle the start of another process."""
        del now_s
        self._begin()

    def companion_ended(self, now_s: float) -> None:
        """Handle the end of the companion, orderly or not."""
        del now_s
        self._keeper.close(0.0)

    def ticked(self, now_s: float) -> None:
        """Run the tasks due at a wake-up."""
        self._keeper.run(now_s)
