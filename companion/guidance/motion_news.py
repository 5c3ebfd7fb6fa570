"""Tells the operator when a target seems to walk that is believed to lie still, and its end."""

from __future__ import annotations

from companion.estimation.motion import Motion
from companion.guidance.commands import Announce, Severity


class MotionNews:
    """What was told of each emitter."""

    def __init__(self) -> None:
        self._walking: set[int] = set()

    def told(self, emitter_id: int, motion: Motion | None) -> list[Announce]:
        """What is news, mostly nothing.

        Args:
            emitter_id: Whose motion.
            motion: How it walks; None: it lies still.
        """
        is_walking, was_walking = motion is not None, emitter_id in self._walking
        if is_walking == was_walking:
            return []
        if motion is None:
            self._walking.remove(emitter_id)
            return [Announce(Severity.INFO, "the target seems to lie still again")]
        self._walking.add(emitter_id)
        pace = f"{motion.speed_mps:.1f} m/s"
        text = f"the target seems to walk at {pace}, or is shadowed: look from all sides"
        return [Announce(Severity.WARNING, text)]
