"""Hardware id of the bound autopilot, which distinguishes vehicles with the same ids.

AUTOPILOT_VERSION contains it, and autopilots send that on request only. So it is requested when an
autopilot is bound, again when its address changed or it was silent for a while, and as long as two
ids are answered. Nothing waits for the answer, and an autopilot that reports none, as many
simulators do, is not doubted for it.

Source: MAVLink common, AUTOPILOT_VERSION, `uid2` ("if this is non-zero, use this field, otherwise
use uid").
"""

from __future__ import annotations

import math

from companion.mav.dialect import Message, mavlink

ASK_PERIOD_S = 1.0
MOST_ASKS = 5
"""Requests for each cause: some autopilots do not support the message. Where 30 % of all frames are
lost, all five remain unanswered in one of thirty cases."""


def uid_of(message: Message) -> str | None:
    """Return the hardware id in a message as hexadecimal digits; None: it has none."""
    if not isinstance(message, mavlink.MAVLink_autopilot_version_message):
        return None
    uid2 = bytes(message.uid2)
    if any(uid2):
        return uid2.hex()
    return f"{message.uid:016x}" if message.uid else None


class HardwareId:
    """Hardware id of one bound autopilot, and the schedule of its requests."""

    def __init__(self) -> None:
        self.uid: str | None = None
        self.heard_s = -math.inf
        """Time of the latest answer."""
        self._asks = 0
        self._asked_s = -math.inf

    def is_due(self, now_s: float) -> bool:
        """Return True if the id is to be requested now, and count the request."""
        if self._asks >= MOST_ASKS or now_s - self._asked_s < ASK_PERIOD_S:
            return False
        self._asks, self._asked_s = self._asks + 1, now_s
        return True

    def ask_again(self) -> None:
        """Request it again, because the sender may have changed."""
        self._asks = 0

    def confirm(self, now_s: float, age_s: float) -> None:
        """Request it again if the latest answer is older than this, in seconds."""
        if self.uid is not None and now_s - self.heard_s > age_s:
            self.ask_again()

    def differs(self, uid: str, now_s: float) -> bool:
        """Process an answered id; return True if another one was answered before."""
        if self.uid is None:
            self.uid = uid
        if uid == self.uid:
            self._asks, self.heard_s = MOST_ASKS, now_s
            return False
        self.ask_again()
        return True
