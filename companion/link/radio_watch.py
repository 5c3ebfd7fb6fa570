"""What the operator and the log are told of the radios: silence, new names, restarts, refusals."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass

from companion.guidance.commands import Announce, Severity
from companion.link.intake import RateLimit
from companion.link.radio_stage import RadioStage

LOOK_S = 0.5
WINDOW_S = 5.0
"""Rates are of so much time."""
REFUSALS_PER_S = 0.1
NOTICED = 10
"""Refusals since the last text, before there is another one ..."""
NOTICED_SHARE = 0.2
"""... if they are more than this share of what came."""


@dataclass(frozen=True, slots=True)
class RadioStatus:
    """One radio, now."""

    name: str
    rate_hz: float
    """Measurements a second."""
    silent_s: float | None
    """Since its last byte; None: it never sent one."""
    age_s: float | None
    """How old its last measurement was when it came."""
    measured: int
    refused: Mapping[str, int]
    restarts: int
    """Of its clock."""
    lost: int
    """How often its line was lost."""


class RadioWatch:
    """Watches one radio's stage; asked at every control tick, it looks twice a second."""

    def __init__(self, stage: RadioStage) -> None:
        self.stage = stage
        self._name = stage.setup.kind.name
        self._next_s = -math.inf
        self._began_s: float | None = None
        self._measured: deque[tuple[float, int]] = deque()
        self._is_silent = False
        self._restarts = 0
        self._told: Counter[str] = Counter()
        self._told_of = 0
        self._may_tell = RateLimit(REFUSALS_PER_S)

    def tick(self, now_s: float) -> list[Announce]:
        """What is news."""
        if now_s < self._next_s:
            return []
        self._next_s = now_s + LOOK_S
        if self._began_s is None:
            self._began_s = now_s
        self._measured.append((now_s, self.stage.measured))
        while now_s - self._measured[0][0] > WINDOW_S:
            self._measured.popleft()
        news = [*self._names(), *self._silence(now_s), *self._clock(), *self._refusals(now_s)]
        return [Announce(severity, f"radio {self._name}: {text}") for severity, text in news]

    def status(self, now_s: float) -> RadioStatus:
        """How it is."""
        stage, heard_s = self.stage, self.stage.received_s
        first_s, first = self._measured[0] if self._measured else (now_s, stage.measured)
        passed_s = now_s - first_s
        return RadioStatus(
            self._name,
            (stage.measured - first) / passed_s if passed_s > 0.0 else 0.0,
            None if heard_s is None else max(0.0, now_s - heard_s),
            stage.age_s,
            stage.measured,
            dict(stage.all_refused.most_common()),
            stage.clock.restarts,
            stage.lost,
        )

    def record(self, now_s: float) -> dict[str, object]:
        """The figures for the event log."""
        status, counts = self.status(now_s), self.stage.decoder.counts
        return {
            "name": status.name,
            "bytes": self.stage.received,
            "frames": counts.frames,
            "measured": status.measured,
            "rate_hz": round(status.rate_hz, 2),
            "silent_s": None if status.silent_s is None else round(status.silent_s, 3),
            "age_s": None if status.age_s is None else round(status.age_s, 4),
            "resync_bytes": counts.resync_bytes,
            "refused": status.refused,
            "restarts": status.restarts,
            "lost": status.lost,
        }

    def _names(self) -> list[tuple[Severity, str]]:
        news = [(Severity.INFO, text) for text in self.stage.names.news]
        self.stage.names.news.clear()
        return news

    def _silence(self, now_s: float) -> list[tuple[Severity, str]]:
        """Said once when it begins, and once when it ends."""
        timeout_s = self.stage.setup.settings.timeout_s
        since_s = self.stage.received_s
        since_s = self._began_s if since_s is None else since_s
        is_silent = timeout_s > 0.0 and since_s is not None and now_s - since_s >= timeout_s
        if is_silent is self._is_silent:
            return []
        self._is_silent = is_silent
        if is_silent:
            return [(Severity.WARNING, f"silent for {timeout_s:g} s")]
        return [(Severity.NOTICE, "is heard again")]

    def _clock(self) -> list[tuple[Severity, str]]:
        restarts = self.stage.clock.restarts
        if restarts == self._restarts:
            return []
        self._restarts = restarts
        return [(Severity.NOTICE, "its clock began anew")]

    def _refusals(self, now_s: float) -> list[tuple[Severity, str]]:
        refused = self.stage.all_refused
        more = refused - self._told
        count = more.total()
        seen = count + self.stage.measured - self._told_of
        if count < NOTICED or count < NOTICED_SHARE * seen or not self._may_tell.acquire(now_s):
            return []
        self._told, self._told_of = refused, self.stage.measured
        words = ", ".join(f"{reason} ({number})" for reason, number in more.most_common(3))
        return [(Severity.WARNING, f"{count} readings were refused: {words}")]
