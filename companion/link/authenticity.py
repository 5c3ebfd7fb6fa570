"""Who may be believed: signing on all links, its clock, and what the operator is told about it.

Theory of operation. With a key every frame of every link must prove itself before it is decoded;
the codecs see to that. The time in signatures goes on from the wall clock at the start by the
control tick's own clock, so that a wall clock that is set in flight changes nothing; only before
an autopilot is bound is it followed. What was refused is told at once, and then at most every ten
seconds in one text, because a forger must not be able to fill the log.

RADIO_STATUS may come unsigned. It is noted down and goes no further: unproved, it says nothing
about the autopilot, not even that it is there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from companion.guidance.commands import Announce, Severity
from companion.mav.signing import LinkSigning, Signing, Verdict, is_signed

REPORT_PERIOD_S = 10.0
HINTS: Mapping[Verdict, str] = {
    Verdict.UNSIGNED: "does the autopilot sign, with this key?",
    Verdict.BAD_SIGNATURE: "is it the same key on both sides?",
    Verdict.TOO_FAR_AHEAD: "its sender has the key; set the clocks, ours or its",
    Verdict.TOO_OLD: "its sender has the key; set the clocks, ours or its",
}
ALARMS = frozenset({Verdict.TOO_FAR_AHEAD, Verdict.TIMESTAMP_OVERFLOW, Verdict.TOO_MANY_STREAMS})
"""What only somebody who has the key can cause."""


class Authenticity:
    """The companion's side of signing.

    Args:
        signing: Proves and signs; None: there is no key, and everyone is believed.
        unix_minus_local_s: Unix time minus the time that is passed in.
    """

    def __init__(self, signing: Signing | None, unix_minus_local_s: float) -> None:
        self._signing = signing
        self._unix_minus_local_s = unix_minus_local_s
        self._told: dict[Verdict, int] = dict.fromkeys(Verdict, 0)
        self._next_report_s = -math.inf

    @property
    def is_on(self) -> bool:
        """Whether there is a key."""
        return self._signing is not None

    def of_link(self, number: int, *, is_trusted: bool) -> LinkSigning | None:
        """What the codec of a link needs.

        Args:
            number: Of the link, from 0.
            is_trusted: Unsigned frames are welcome on it, by configuration.
        """
        if self._signing is None:
            return None
        return LinkSigning(self._signing, number % 256, is_trusted)

    def set_clock(self, unix_s: float, now_s: float) -> None:
        """Take the wall clock as it is now."""
        self._unix_minus_local_s = unix_s - now_s

    def is_proved(self, frame: bytes) -> bool:
        """Whether a frame that was accepted may say something about the autopilot."""
        return self._signing is None or is_signed(frame)

    def advance(self, now_s: float) -> None:
        """Let the time in signatures go on."""
        if self._signing is not None:
            self._signing.advance(now_s + self._unix_minus_local_s)

    def tick(self, now_s: float) -> list[Announce]:
        """The same at a control tick; what the operator is to be told."""
        self.advance(now_s)
        if self._signing is None or now_s < self._next_report_s:
            return []
        news = {
            verdict: count - self._told[verdict]
            for verdict, count in self._signing.verdicts.items()
            if not verdict.is_accepted and count > self._told[verdict]
        }
        if not news:
            return []
        self._told = dict(self._signing.verdicts)
        self._next_report_s = now_s + REPORT_PERIOD_S
        severity = Severity.ERROR if ALARMS & news.keys() else Severity.WARNING
        return [Announce(severity, f"signing: refused {_in_words(news)}")]

    def record(self) -> dict[str, object]:
        """The figures for the event log: how many frames got which verdict."""
        if self._signing is None:
            return {}
        verdicts = self._signing.verdicts
        return {"signing": {v.value: count for v, count in verdicts.items() if count}}


def _in_words(news: Mapping[Verdict, int]) -> str:
    parts = []
    for verdict, count in news.items():
        hint = f" ({HINTS[verdict]})" if verdict in HINTS else ""
        parts.append(f"{count} x {verdict.value}{hint}")
    return ", ".join(parts)
