"""Gate of all operator texts: each cause at most once in a period, within a byte budget.

Theory of operation. The cause of a text is its wording without numbers, and without the list of
missing inputs. A cause is announced at most once in `CAUSE_PERIOD_S`, however often it recurs.
Texts of one topic are states that replace each other, such as "waiting for ..." and "ready"; there
the newest withheld state is announced as soon as its cause may be, unless the topic has gone back
to the announced one. So the last text of a topic is the current state, at the latest after one
period. Changes of control are never withheld: they are answers to the pilot, and guidance already
spaces them.

Announced texts go to the log and the console. On the air they also have to fit into a share of the
slowest downlink, over a sliding minute; errors and changes of control exceed it rather than get
lost.

Source: ArduPilot issue 14034, a position that flaps at 2 Hz; MAVLink common, STATUSTEXT (253).
"""

from __future__ import annotations

import math
import re
from collections import deque
from dataclasses import dataclass

from companion.guidance.commands import Announce, Severity, Topic

CAUSE_PERIOD_S = 30.0
"""Seconds between two texts of one cause: twice MAVLink's usual link-loss timeout (15 s), and few
enough that ten causes that flap at once stay readable."""
MINUTE_S = 60.0
SHARE_OF_DOWNLINK = 0.01
"""Share of the downlink's capacity for texts; telemetry needs the rest."""
NUMBER = re.compile(r"(?<![\w.])(?<!system )(?<!emitter )-?\d[\d.]*")
"""Numbers that do not distinguish causes; ids of systems and emitters do, and numbers in names."""
WAITED_FOR = re.compile(r"(?<=\bwaiting for ).*")
"""List of missing inputs, which shrinks after a start: one cause, whatever it contains."""


@dataclass(slots=True)
class _TopicState:
    """Announced state of one topic, and a newer one that is withheld."""

    announced: str = ""
    withheld: Announce | None = None


class TextGate:
    """Filter of announced texts, and of those sent by a radio of `bytes_per_s`."""

    def __init__(self, bytes_per_s: float) -> None:
        self.withheld = 0
        """Texts that were withheld on arrival."""
        self.unsent = 0
        """Announced texts that did not fit into the budget of the downlink."""
        self._budget_bytes = SHARE_OF_DOWNLINK * bytes_per_s * MINUTE_S
        self._announced_s: dict[str, float] = {}
        """Time of the last announcement of each cause."""
        self._topics: dict[Topic | str, _TopicState] = {}
        self._sent: deque[tuple[float, int]] = deque()
        self._sent_bytes = 0

    def admit(self, text: Announce, now_s: float) -> bool:
        """Return True if a text is to be announced now; withheld states may become due later."""
        words = NUMBER.sub("#", text.text)
        cause = WAITED_FOR.sub("", words)
        topic = self._topics.setdefault(text.topic, _TopicState()) if text.topic else None
        if topic is not None:
            topic.withheld = None if words == topic.announced else text
        is_recent = now_s - self._announced_s.get(cause, -math.inf) < CAUSE_PERIOD_S
        if is_recent and not text.must_pass:
            self.withheld += 1
            return False
        self._announced_s[cause] = now_s
        if topic is not None:
            topic.announced, topic.withheld = words, None
        self._forget(now_s)
        return True

    def due(self, now_s: float) -> list[Announce]:
        """Return the withheld states whose cause may be announced again now."""
        waiting = [topic.withheld for topic in self._topics.values() if topic.withheld is not None]
        due = []
        for text in waiting:
            before = self.withheld
            if self.admit(text, now_s):
                due.append(text)
            self.withheld = before  # counted on arrival
        return due

    def fits(self, text: Announce, size_bytes: int, now_s: float) -> bool:
        """Return True if the downlink may carry a text of this size in bytes, and count it."""
        while self._sent and self._sent[0][0] <= now_s - MINUTE_S:
            self._sent_bytes -= self._sent.popleft()[1]
        is_needed = text.must_pass or text.severity is Severity.ERROR
        if not is_needed and self._sent_bytes + size_bytes > self._budget_bytes:
            self.unsent += 1
            return False
        self._sent.append((now_s, size_bytes))
        self._sent_bytes += size_bytes
        return True

    def _forget(self, now_s: float) -> None:
        """Drop old causes, so that forged texts cannot fill the memory."""
        if len(self._announced_s) > MAX_CAUSES:
            self._announced_s = {
                cause: time_s
                for cause, time_s in self._announced_s.items()
                if now_s - time_s < CAUSE_PERIOD_S
            }


MAX_CAUSES = 256
"""Number of causes at which old ones are dropped."""
