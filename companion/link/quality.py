"""Link quality: order, loss, control rate, floods, and the state of radios.

Theory of operation. A sender counts its frames modulo 256. Unwrapped to the nearest value, the
count gives the order of sending and the number of lost frames; both are right as long as no frame
is late by 128 others or more (0.3 s of the 405 frames a second of PX4 1.15). After a silence, or a
pause in reading, a count that seems to have gone back went ahead instead. The loss is the share of
the numbers that the count advanced in the last seconds without their frames.

The control tick runs 20 times a second, and 50 on a lossy line: at 30 % loss the longest gap in ten
hours between two setpoints that arrive is over half a second at 20 Hz, and under 0.4 s at 50 Hz;
PX4 gives up after 1 s. The loss is that of the autopilot's own frames: the loss on the way to it is
not reported, and radios lose both ways. A late tick is not made up for. A very late one is a stall:
the vehicle's state and the setpoints are out of date.

The shield against floods accepts only the autopilot, by a filter of the shell and the kernel
(`companion.io.links.udp`). It is up only while unknown peers exceed their budget, because otherwise
they are reported to the operator, and only while the autopilot sends, because it may return from
another address. The alarms monitor counters, so that no input of an unknown peer makes a text of
its own: they are announced within a second, and then rarely. Each radio with a format of its own is
monitored, too: silence, new names, clock restarts, many refusals.

Source: MAVLink developer guide, "Packet Loss".
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from companion.guidance.commands import Announce, Severity
from companion.link.binding import AutopilotBinding
from companion.link.intake import Intake, RateLimit
from companion.link.interface import LinkParams
from companion.link.radio_stage import RadioStage
from companion.link.text_gate import CAUSE_PERIOD_S

MODULUS = 256
HALF = MODULUS // 2
_ALL_SEEN = (1 << HALF) - 1
SILENCE_S = 0.3
"""Silence after which frames are lost rather than late."""
WINDOW_S = 3.0
"""Span over which the loss is measured."""
BUCKET_S = 0.1
MIN_EXPECTED = 20
"""Minimum number of expected frames in that span for a measurement."""


class SequenceMonitor:
    """Sequence numbers of one sender, for example the autopilot component."""

    def __init__(self) -> None:
        self.received = 0
        """Frames so far, duplicates not counted."""
        self.lost = 0
        """Numbers that were skipped and have not arrived since."""
        self.duplicates = 0
        self.late = 0
        self._newest: int | None = None
        self._heard_s = 0.0
        self._seen = 0
        """Bit n is set if number `newest - n` arrived."""
        self._buckets: deque[list[float]] = deque()
        """Start, numbers that the count advanced, and frames received in each tenth of a second."""

    def take(self, sequence: int, now_s: float) -> int:
        """Return the unwrapped number of a frame, which may be a duplicate."""
        if self._newest is None:
            self._newest, self._seen, self._heard_s = sequence - 1, 0, now_s
        ahead = (sequence - self._newest) % MODULUS
        if ahead >= HALF and now_s - self._heard_s <= SILENCE_S:
            ahead -= MODULUS
        if ahead == 0 and now_s - self._heard_s > SILENCE_S:
            ahead = MODULUS
        if now_s > self._heard_s:
            self._heard_s = now_s
        if ahead > 0:
            self._newest += ahead
            self._seen = (self._seen << ahead | 1) & _ALL_SEEN
            self.lost += ahead - 1
            number, advanced = self._newest, ahead
        elif self._seen >> -ahead & 1:
            self.duplicates += 1
            return self._newest + ahead
        else:
            self.late += 1
            # a frame from before the first one was not counted as lost
            self.lost = max(0, self.lost - 1)
            self._seen |= 1 << -ahead
            number, advanced = self._newest + ahead, 0
        self.received += 1
        if not self._buckets or now_s - self._buckets[-1][0] >= BUCKET_S:
            self._buckets.append([now_s, 0, 0])
            while self._buckets[0][0] <= now_s - WINDOW_S:
                self._buckets.popleft()
        newest = self._buckets[-1]
        newest[1] += advanced
        newest[2] += 1
        return number

    def exclude(self, count: int) -> None:
        """Exclude frames that arrived but could not be verified from the loss.

        They are of messages that the dialect lacks, as from a newer autopilot.
        """
        if self._buckets:
            self.received += count
            self.lost -= count
            self._buckets[-1][2] += count

    def loss(self, now_s: float) -> float | None:
        """Return the share of recent frames that were lost, 0 to 1; None if too few were due."""
        since_s = now_s - WINDOW_S
        expected = arrived = 0.0
        for began_s, numbers, frames in self._buckets:
            if began_s > since_s:
                expected += numbers
                arrived += frames
        if expected < MIN_EXPECTED:
            return None
        return min(max(0.0, 1.0 - arrived / expected), 1.0)

    def skip(self) -> None:
        """Take the next number as ahead, however far: many recent frames may be lost."""
        self._heard_s = -math.inf

    def restart(self) -> None:
        """Start again after a restart of the sender; the totals stay."""
        self._newest = None
        self._buckets.clear()


CALM_SHARE = 0.5
"""Share of the loss limit below which a line counts as good again."""
CALM_S = 5.0
"""Time for which a line must be good before the rate goes down again."""
STALL_S = 0.5
"""Delay of a tick after which position and mode of the vehicle are unknown."""


class Pacing:
    """Period of the control tick."""

    def __init__(self, params: LinkParams) -> None:
        self._params = params
        self._calm_since_s: float | None = None
        self.is_lossy = False
        self.period_s = 1.0 / params.rate_hz
        """Time from one tick to the next."""

    def observe(self, loss: float | None, now_s: float) -> None:
        """Process the measured loss, 0 to 1; None, unknown, has no effect."""
        if loss is None:
            return
        if loss > self._params.lossy_share:
            self.is_lossy = True
        if loss >= CALM_SHARE * self._params.lossy_share:
            self._calm_since_s = None
        elif self._calm_since_s is None:
            self._calm_since_s = now_s
        elif now_s - self._calm_since_s >= CALM_S:
            self.is_lossy = False
        self.period_s = 1.0 / (
            self._params.lossy_rate_hz if self.is_lossy else self._params.rate_hz
        )


class LinkHealth:
    """Health of the link to the bound autopilot, and punctuality of the control tick."""

    def __init__(self, params: LinkParams) -> None:
        self.sequence = SequenceMonitor()
        self.pacing = Pacing(params)
        self.missed_ticks = 0
        """Ticks that were due and were skipped by a late one."""
        self.stalls = 0
        self._ticked_s: float | None = None

    def tick(self, now_s: float) -> float | None:
        """Update at a control tick; return the duration of a stall of the loop, s, or None."""
        gap_s = 0.0 if self._ticked_s is None else now_s - self._ticked_s
        self._ticked_s = now_s
        self.missed_ticks += max(0, round(gap_s / self.pacing.period_s) - 1)
        if gap_s > STALL_S:
            self.stalls += 1
            self.sequence.skip()  # the socket's buffer kept the oldest frames
        self.pacing.observe(self.sequence.loss(now_s), now_s)
        return gap_s if gap_s > STALL_S else None

    def record(self, now_s: float) -> dict[str, object]:
        """Return the figures for the event log."""
        sequence = self.sequence
        return {
            "loss": sequence.loss(now_s),
            "received": sequence.received,
            "lost": sequence.lost,
            "late": sequence.late,
            "duplicates": sequence.duplicates,
            "tick_s": self.pacing.period_s,
            "missed_ticks": self.missed_ticks,
            "stalls": self.stalls,
        }


ALARM_TEXTS_PER_S = 1.0 / CAUSE_PERIOD_S


class CounterIncrement:
    """Increments of a counter since the last announcement."""

    def __init__(self) -> None:
        self._announced = 0
        self._text_limit = RateLimit(ALARM_TEXTS_PER_S)

    def take(self, count: int, now_s: float) -> int:
        """Return the increment to announce now, of a counter that is at `count`."""
        if count <= self._announced or not self._text_limit.acquire(now_s):
            return 0
        more, self._announced = count - self._announced, count
        return more


class LinkAlarms:
    """Alarms on counters, checked once a second."""

    def __init__(self, binding: AutopilotBinding, intakes: Sequence[Intake]) -> None:
        self._binding = binding
        self._intakes = intakes
        self._others: set[int] = set()
        self._moves, self._senders = CounterIncrement(), CounterIncrement()
        self._floods = CounterIncrement()

    def texts(self, now_s: float) -> list[Announce]:
        """Return the alarms that are due."""
        binding, texts = self._binding, []
        dropped = sum(intake.budget.dropped_unread for intake in self._intakes)
        for other in binding.others if binding.is_committed else ():
            if other not in self._others:
                texts.append(
                    f"another autopilot is on this link, system {other}; ours is "
                    f"{binding.system_id} (vehicle.system_id chooses)"
                )
                self._others.add(other)
        if self._moves.take(binding.moves, now_s):
            address = "the line" if binding.peer is None else f"{binding.peer[0]}:{binding.peer[1]}"
            texts.append(f"autopilot now heard from another address: {address}")
        if count := self._senders.take(binding.unknown_senders, now_s):
            texts.append(f"{count} frames with the autopilot's ids from other senders were ignored")
        if count := self._floods.take(dropped, now_s):
            texts.append(f"flood: {count} datagrams or frames were dropped unread")
        return [Announce(Severity.WARNING, text) for text in texts]


RADIO_LOOK_S = 0.5
QUIET_S = 2.0
"""Silence of a radio above which it is shown."""
RATE_WINDOW_S = 5.0
"""Span over which rates are measured."""
REFUSAL_TEXTS_PER_S = 1.0 / CAUSE_PERIOD_S
MANY_REFUSALS = 10
"""Refusals since the last text that make another one due, if they exceed `MANY_SHARE`."""
MANY_SHARE = 0.2
"""Share of all readings that refusals must exceed for a text."""


@dataclass(frozen=True, slots=True)
class RadioStatus:
    """Current state of one radio."""

    name: str
    rate_hz: float
    silent_s: float | None
    """Time since its last byte; None: none yet."""
    age_s: float | None
    """Age of its last measurement on arrival."""
    measured: int
    refused: Mapping[str, int]
    restarts: int
    """Restarts of its clock."""
    lost: int
    """Number of losses of its connection."""
    unrecognised: str = ""
    """Description of input that is not of its format."""

    @property
    def text(self) -> str:
        """State of the radio as text."""
        if self.silent_s is None:
            return "not heard"
        parts = [f"{self.rate_hz:.0f} measurements/s"]
        if self.silent_s >= QUIET_S:
            parts.append(f"silent for {self.silent_s:.0f} s")
        refused = sum(self.refused.values())
        if refused:
            most = max(self.refused, key=lambda reason: self.refused[reason])
            parts.append(f"{refused} refused, mainly: {most}")
        if self.unrecognised and not self.measured:
            parts.append(self.unrecognised)
        return ", ".join(parts)


UNCALIBRATED = "uncalibrated: range offset unknown; companion radio calibrate --beside 1"


class RadioWatch:
    """Monitor of one radio's stage; called at every control tick, it checks twice a second."""

    def __init__(self, stage: RadioStage) -> None:
        self.stage = stage
        self._name = stage.setup.kind.name
        self._next_s = -math.inf
        self._began_s: float | None = None
        self._measured: deque[tuple[float, int]] = deque()
        self._is_silent = False
        self._is_offset_said = False
        self._restarts = 0
        self._announced: Counter[str] = Counter()
        self._announced_of = 0
        self._text_limit = RateLimit(REFUSAL_TEXTS_PER_S)

    def tick(self, now_s: float) -> list[Announce]:
        """Return the texts that are due."""
        if now_s < self._next_s:
            return []
        self._next_s = now_s + RADIO_LOOK_S
        if self._began_s is None:
            self._began_s = now_s
        self._measured.append((now_s, self.stage.measured))
        while now_s - self._measured[0][0] > RATE_WINDOW_S:
            self._measured.popleft()
        news = [*self._names(), *self._clock(), *self._refusals(now_s)]
        if self.stage.setup.is_uncalibrated and self.stage.measured and not self._is_offset_said:
            self._is_offset_said = True
            news.append((Severity.WARNING, UNCALIBRATED))
        topic = f"radio {self._name}"
        states = [
            Announce(level, f"{topic}: {text}", topic) for level, text in self._silence(now_s)
        ]
        return [*states, *(Announce(severity, f"{topic}: {text}") for severity, text in news)]

    def status(self, now_s: float) -> RadioStatus:
        """Return the current state."""
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
            stage.unrecognised,
        )

    def record(self, now_s: float) -> dict[str, object]:
        """Return the figures for the event log."""
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
            "unrecognised": status.unrecognised,
            "thinned": self.stage.thinned,
            "refused": status.refused,
            "clock_restarts": status.restarts,
            "line_losses": status.lost,
        }

    def _names(self) -> list[tuple[Severity, str]]:
        news = [(Severity.INFO, text) for text in self.stage.names.texts]
        self.stage.names.texts.clear()
        return news

    def _silence(self, now_s: float) -> list[tuple[Severity, str]]:
        """Return a text when a silence begins, and one when it ends."""
        timeout_s = self.stage.setup.settings.timeout_s
        since_s = self.stage.received_s
        since_s = self._began_s if since_s is None else since_s
        is_silent = timeout_s > 0.0 and since_s is not None and now_s - since_s >= timeout_s
        if is_silent is self._is_silent:
            return []
        self._is_silent = is_silent
        if is_silent:
            return [(Severity.WARNING, f"silent for {timeout_s:g} s")]
        return [(Severity.NOTICE, "heard again")]

    def _clock(self) -> list[tuple[Severity, str]]:
        restarts = self.stage.clock.restarts
        if restarts == self._restarts:
            return []
        self._restarts = restarts
        return [(Severity.NOTICE, "clock restarted")]

    def _refusals(self, now_s: float) -> list[tuple[Severity, str]]:
        refused = self.stage.all_refused
        more = refused - self._announced
        count = more.total()
        seen = count + self.stage.measured - self._announced_of
        is_many = count >= MANY_REFUSALS and count >= MANY_SHARE * seen
        if not (is_many and self._text_limit.acquire(now_s)):
            return []
        self._announced, self._announced_of = refused, self.stage.measured
        words = ", ".join(f"{reason} ({number})" for reason, number in more.most_common(3))
        return [(Severity.WARNING, f"{count} readings were refused: {words}")]
