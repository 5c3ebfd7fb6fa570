"""Errors of the estimator and the planner end neither the process nor the control tick.

The vehicle stays where it is: the guard needs neither of them. Three errors in ten seconds are no
accident, and the vehicle is handed back. The guard itself is not wrapped: without it nothing may be
sent, so its error ends the process, and the autopilot's own failsafe follows.
"""

from __future__ import annotations

import traceback
from collections import Counter, deque
from collections.abc import Callable
from pathlib import PurePath

from companion.guidance.commands import Announce, Command, Record, Severity
from companion.guidance.findings import Finding, Reason, Verdict

HOLD_S = 1.0
"""After an error nothing is flown on what failed for this long."""
WINDOW_S = 10.0
MOST_ERRORS = 3
TELL_S = 10.0
"""The same part is told of no more often."""


class Containment:
    """Keeps the errors of parts."""

    def __init__(self) -> None:
        self.errors: Counter[str] = Counter()
        """By part."""
        self._times_s: deque[float] = deque(maxlen=MOST_ERRORS)
        self._told_s: dict[str, float] = {}
        self._news: list[Command] = []

    def run(self, part: str, now_s: float, work: Callable[[], None]) -> bool:
        """Let a part do its work; whether it did, without an error."""
        try:
            work()
        except Exception as error:
            self._note(part, error, now_s)
            return False
        return True

    def take_news(self) -> list[Command]:
        """What is to be told; taken once."""
        news, self._news = self._news, []
        return news

    def finding(self, now_s: float) -> Finding | None:
        """What the errors of late mean."""
        times_s = self._times_s
        if len(times_s) == MOST_ERRORS and now_s - times_s[0] <= WINDOW_S:
            text = f"{MOST_ERRORS} internal errors in {WINDOW_S:g} s"
            return Finding(Verdict.HAND_BACK, Reason.INTERNAL_ERROR, text)
        if times_s and now_s - times_s[-1] < HOLD_S:
            return Finding(Verdict.HOLD, Reason.INTERNAL_ERROR, "internal error")
        return None

    def _note(self, part: str, error: Exception, now_s: float) -> None:
        self.errors[part] += 1
        self._times_s.append(now_s)
        what = f"{type(error).__name__}: {error}"
        last = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{PurePath(last.filename).name}:{last.lineno}"
        self._news.append(Record("internal_error", {"part": part, "error": what, "where": where}))
        told_s = self._told_s.get(part)
        if told_s is None or now_s - told_s >= TELL_S:
            self._told_s[part] = now_s
            self._news.append(Announce(Severity.ERROR, f"internal error in the {part}: {what}"))
