"""What the operator asks for beside the mode switch: HOLD, RESUME and RETURN."""

from __future__ import annotations

from companion.domain import FlightMode
from companion.guidance.events import Wish
from companion.guidance.findings import Finding, Reason, Verdict
from companion.guidance.situation import Situation
from companion.guidance.states import IN_CONTROL

HELD = Finding(Verdict.HOLD, Reason.OPERATOR_HOLDS, "the operator asked to hold")
RETURNS = Finding(
    Verdict.HAND_BACK, Reason.OPERATOR_RETURNS, "the operator asked to return", FlightMode.RETURN
)


class WishWatch:
    """Remembers the operator's last wish while the companion is in control.

    A wish ends with the control it was made under: who gives the mode again wants to fly.

    Args:
        situation: Of the session.
    """

    def __init__(self, situation: Situation) -> None:
        self._situation = situation
        self._finding: Finding | None = None

    def ask(self, wish: Wish) -> None:
        """Take in a wish; without control there is nothing to hold or to return."""
        if self._situation.phase not in IN_CONTROL:
            return
        match wish:
            case Wish.HOLD:
                self._finding = HELD
            case Wish.RESUME:
                self._finding = None
            case Wish.RETURN:
                self._finding = RETURNS

    def tick(self) -> None:
        """Forget a wish when the control it was made under has ended."""
        if self._situation.phase not in IN_CONTROL:
            self._finding = None

    def finding(self) -> Finding | None:
        """What the operator wants instead of the plan."""
        return self._finding
