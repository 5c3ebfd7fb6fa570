"""When a flood makes it worth while to hear nobody but the autopilot.

The filter itself is the shell's, and the kernel's; see `companion.io.source_filter`. It is up only
while strangers exceed their budget, because without it they are told to the operator, and only
while the autopilot speaks, because it may come back from another address.
"""

from __future__ import annotations

import math

from companion.link.binding import AutopilotBinding
from companion.link.intake import Intake
from companion.mav.endpoint import Address

UP_S = 10.0
"""How long after the last flood it stays up; then it is looked whether the flood goes on."""
SHARE_OF_SILENCE = 0.5
"""Of the silence after which another address is believed: so long the autopilot may be quiet."""


class FloodShield:
    """Looks at one link's budget once per control tick.

    Args:
        intake: Of the vehicle's link.
        binding: The autopilot.
    """

    def __init__(self, intake: Intake, binding: AutopilotBinding) -> None:
        self._intake = intake
        self._binding = binding
        self._dropped = 0
        self._flooded_s = -math.inf

    def tick(self, now_s: float) -> None:
        """Note whether anything was over budget."""
        dropped = self._intake.budget.dropped_unread
        if dropped > self._dropped:
            self._dropped = dropped
            self._flooded_s = now_s

    def sole_peer(self, now_s: float) -> Address | None:
        """Whom alone to hear now; None: everybody."""
        binding = self._binding
        if now_s - self._flooded_s > UP_S or not binding.is_bound or binding.heard_s is None:
            return None
        is_quiet = now_s - binding.heard_s > SHARE_OF_SILENCE * binding.silence_s
        return None if is_quiet else binding.peer
