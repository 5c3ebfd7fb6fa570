"""What is wrong, for the operator and the log, and not twenty times a second.

Theory of operation. What was told stays true for the operator until it has been gone for a while,
or something worse comes: then the new state is told. A reason that was not told for long is told
at once. So two reasons that take turns at every tick are told once each, and whatever lasts is
told, at the latest a moment after it began. A lost link never waits: it is over only after a
second, so it cannot flicker.
"""

from __future__ import annotations

import math

from companion.guidance.findings import Finding, Reason

GONE_S = 1.0
"""What was told is over when it was not so for this long."""
URGENT = frozenset({Reason.NO_LINK})
TOLD_AGAIN_S = 10.0
"""The same is not told sooner while what was told before comes and goes."""


class FindingNews:
    """Remembers what was told while in control; None stands for "nothing is wrong"."""

    def __init__(self) -> None:
        self._told: Reason | None = None
        self._told_verdict = 0
        self._seen_s = -math.inf
        """When what was told was so last."""
        self._told_s: dict[Reason | None, float] = {}

    def is_due(self, finding: Finding | None, now_s: float) -> bool:
        """Whether what is wrong now, or that nothing is, is to be told."""
        reason = None if finding is None else finding.reason
        if reason is self._told:
            self._seen_s = now_s
            return False
        verdict = 0 if finding is None else int(finding.verdict)
        since_told_s = now_s - self._told_s.get(reason, -math.inf)
        is_worse = verdict > self._told_verdict or reason in URGENT
        is_worse = is_worse and since_told_s >= GONE_S
        if not (is_worse or now_s - self._seen_s >= GONE_S or since_told_s >= TOLD_AGAIN_S):
            return False
        self._told, self._told_verdict, self._seen_s = reason, verdict, now_s
        self._told_s[reason] = now_s
        return True
