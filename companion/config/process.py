"""What the process keeps on disk: logs of its flights, and what must outlive it."""

from __future__ import annotations

from typing import Annotated

import msgspec

from companion.params import Params, Positive

AtLeastOne = Annotated[int, msgspec.Meta(ge=1)]


class LogConfig(Params, frozen=True):
    """What is kept of a flight."""

    directory: str = "flights"
    """Each flight makes its own folder in here."""
    max_mb: Annotated[float, msgspec.Meta(ge=1.0)] = 1000.0
    """Cap of one flight's logs; of a longer flight the newest is kept. A tenth is for events."""
    mcap: bool = False
    """Whether flight.mcap is written as well, for Foxglove; needs the extra `mcap`."""
    keep_flights: AtLeastOne | None = None
    """The folders of older flights than this many are deleted at the start; null: none ever."""

    @property
    def max_bytes(self) -> int:
        """The cap of one flight."""
        return int(1e6 * self.max_mb)


class ProcessConfig(Params, frozen=True):
    """How a process follows the one before it."""

    state_directory: str | None = None
    """For checkpoints and locks; null: systemd's StateDirectory, or ~/.local/state/companion."""
    checkpoint: bool = True
    """Whether the mission's memory is kept, once a second, for a restart in flight."""
    resume_max_age_s: Positive = 600.0
    """An older memory is not taken up."""
