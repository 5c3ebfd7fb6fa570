"""What is done at the end of every wake-up, and must never end a flight.

Flying comes first: a chore that raises is a bug of ours, is told once and not done again. It is not
retried, because what failed at 20 Hz fails again, and its log would fill the disk.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

from companion.guidance.commands import Announce, Severity
from companion.link.endpoint import CompanionEndpoint

log = logging.getLogger("companion.run")

Chore = Callable[[float], None]
"""Called with the session's time."""


class Chores:
    """Does them in order.

    Args:
        endpoint: Whose operator is told of a chore that failed.
        chores: By the names that the operator reads.
    """

    def __init__(self, endpoint: CompanionEndpoint, chores: dict[str, Chore]) -> None:
        self._endpoint = endpoint
        self._chores = dict(chores)

    def run(self, now_s: float) -> None:
        """Do what is left of them."""
        for name, chore in list(self._chores.items()):
            try:
                chore(now_s)
            except Exception:
                del self._chores[name]
                log.exception("%s: failed", name)
                text = f"internal error: {name} ended; flying on"
                self._endpoint.executor.execute(Announce(Severity.ERROR, text), now_s)
