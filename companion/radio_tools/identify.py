"""`companion radio identify @URL`: which radio it is that talks there, and what to type for it.

Every built-in decoder reads the same bytes; the one that understands most of them has it. Noise is
understood by none: a decoder must read several measurements, and one of binary frames most bytes.

Theory of operation. The time is shared out over the ways to listen: the speeds of a serial port,
the modules that say nothing before they are asked, the pages of a host. A way on which something
was measured is not left before the time is over; one on which only garbage comes is left early, and
what it leaves goes to the others. So the whole never takes longer than asked for.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import msgspec

from companion.config.radios import RadioConfig, radio_setup
from companion.errors import CompanionError
from companion.io.links.radio_lines import radio_link
from companion.io.shell import Clock, Shell
from companion.mav.endpoint import Chunk, OneShotEndpoint
from companion.radios.catalogue import BUILT_IN, radio_kind
from companion.radios.decoder import FrameDecoder, Poll, RadioDecoder, RadioKind
from companion.radios.power_only import POWER_ONLY

LISTEN_S = 10.0
BAUDS = (115_200, 921_600, 57_600, 9_600)
"""Those of the built-in radios and of what their makers offer beside, the usual one first."""
FEWEST = 2
"""Readings: a single one may be chance, and slow radios give one or two in the time."""
HEARD_SHARES = (3.0, 1.5, 0.75, 0.75)
"""Of the time, for each of those speeds: slow radios are text at the first, the second is fast."""
ASKED_SHARE = 1.0
"""Of the time, for each radio that is asked."""
GARBAGE_BYTES, GARBAGE_SHARE = 1000, 0.5
"""So many bytes of which so many are no text, and nothing measured: another speed."""
FEWEST_POWERS = 3
"""Lines of received power alone, to say so."""
FEWEST_FRAMES_SHARE = 0.5
"""Of the bytes, in binary formats, whose short frames without a checksum occur in noise."""
TEXT = bytes((*b"\t\n\r\x1b", *range(0x20, 0x7F)))
NO_LINES = ("lines",)
"""It reads whatever it is configured for."""
OPTIONS: Mapping[str, Mapping[str, object]] = {
    "srsran": {"loop_is_off": True, "numerology": 1},
    "oai": {"numerology": 1},
    "android_rtt": {"unit": "mm", "single_emitter": True},
}
"""With which a format's stream has readings, whatever its cell or app is."""


@dataclass(slots=True)
class _Candidate:
    """One built-in radio that reads what comes."""

    name: str
    decoder: RadioDecoder
    readings: int = 0
    emitters: set[str | int | None] = field(default_factory=set)

    def feed(self, data: bytes, now_s: float) -> None:
        """Read some bytes."""
        found = self.decoder.feed(data, now_s)
        self.readings += len(found)
        self.emitters.update(reading.emitter for reading in found[:16])


class Listener:
    """All candidates on one stream."""

    def __init__(self, names: Sequence[str] = tuple(BUILT_IN)) -> None:
        self.bytes = 0
        self._no_text = 0
        self.candidates = [
            _Candidate(name, kind.decoder(options))
            for name in names
            if name not in NO_LINES
            for kind in [radio_kind(name)]
            for options in [msgspec.convert(OPTIONS.get(name, {}), kind.decoder.Options)]
        ]

    def feed(self, data: bytes, now_s: float) -> None:
        """Let every candidate read some bytes."""
        self.bytes += len(data)
        self._no_text += len(data.translate(None, TEXT))
        for candidate in self.candidates:
            candidate.feed(data, now_s)

    @property
    def found(self) -> _Candidate | None:
        """The radio, if one understands enough; the one with the fewest bytes left over."""
        fitting = [each for each in self.candidates if self._is_fitting(each, FEWEST)]
        return min(fitting, key=_left_over, default=None)

    @property
    def is_promising(self) -> bool:
        """Return True if something was measured, or its power: the radio may be a slow one."""
        is_heard = self.powers >= FEWEST_POWERS
        return is_heard or any(self._is_fitting(each, 1) for each in self.candidates)

    @property
    def is_garbage(self) -> bool:
        """Return True if much came that is neither text nor measured."""
        return (
            self.bytes >= GARBAGE_BYTES
            and self._no_text > GARBAGE_SHARE * self.bytes
            and not self.is_promising
        )

    @property
    def powers(self) -> int:
        """Lines of received power alone."""
        return max(each.decoder.counts.refused[POWER_ONLY] for each in self.candidates)

    def _is_fitting(self, candidate: _Candidate, fewest: int) -> bool:
        counts = candidate.decoder.counts
        if counts.is_introduced:
            return True
        if candidate.readings < fewest:
            return False
        read = 1.0 - counts.resync_bytes / max(1, self.bytes)
        return read >= FEWEST_FRAMES_SHARE or not isinstance(candidate.decoder, FrameDecoder)


def _left_over(candidate: _Candidate) -> tuple[int, int, int]:
    counts = candidate.decoder.counts
    return (counts.resync_bytes, counts.refused.total(), -candidate.readings)


class Ear(OneShotEndpoint):
    """Hears one line until it is clear which radio it is, or this way's time is over."""

    def __init__(self, listener: Listener, share_s: float, most_s: float) -> None:
        super().__init__(most_s)
        self.listener = listener
        self._share_s = share_s

    @property
    def is_finished(self) -> bool:
        """Return True at the end of all time, or of this way's, or once it makes no sense."""
        listener = self.listener
        if super().is_finished or listener.found is not None or listener.is_garbage:
            return True
        return self.now_s >= self._share_s and not listener.is_promising

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Take in what arrived."""
        super().receive(chunk, now_s)
        self.listener.feed(chunk.data, now_s)


@dataclass(frozen=True, slots=True)
class Attempt:
    """One way to listen: as which radio, where, for how long."""

    radio: str
    url: str
    baud: int | None = None
    share: float = 1.0
    """Of the time, beside the other attempts' shares."""
    share_s: float = 0.0
    most_s: float = 0.0
    """The same in seconds, and how long it may take if something was measured."""


def attempts(url: str) -> list[Attempt]:
    """The ways to listen at a URL, in order: speeds of a serial port, pages of a host.

    What only answers is asked before the other speeds, because it is the first at which it does.
    """
    head = url.partition(":")[0].lower()
    if url.startswith("/") or head == "serial":
        device, _, given = url.removeprefix("serial:").partition(":")
        bauds = [int(given)] if given.isdigit() else list(BAUDS)
        heard = [
            Attempt("ndjson", f"serial:{device}:{baud}", baud, share)
            for baud, share in zip(bauds, HEARD_SHARES, strict=False)
        ]
        at = f"serial:{device}:{bauds[0]}"
        asked = [Attempt(name, at, bauds[0], ASKED_SHARE) for name in _asked()]
        return heard[:1] + asked + heard[1:]
    for plain in ("http", "ws"):
        if head in (plain, f"{plain}s"):
            served = [n for n in BUILT_IN if radio_kind(n).transport.startswith(plain)]
            return [Attempt(name, url) for name in served]
    names = _asked() if head.startswith("tcp") else []
    heard = [Attempt("ndjson", url, share=HEARD_SHARES[0])]
    return heard + [Attempt(name, url, share=ASKED_SHARE) for name in names]


def _asked() -> list[str]:
    """Radios that say nothing before they are asked."""
    polls = {name: radio_kind(name).poll for name in BUILT_IN}
    return [n for n, poll in polls.items() if poll is not None and (poll.request or poll.probe)]


Clocked = Callable[[], float]
Listen = Callable[[Attempt, Listener], None]


def timed(ways: Sequence[Attempt], seconds: float, clock: Clocked) -> Iterator[Attempt]:
    """Yield each with its part of the time that the ones before it have left."""
    end_s = clock() + seconds
    for number, way in enumerate(ways):
        left_s = max(0.0, end_s - clock())
        share_s = left_s * way.share / sum(each.share for each in ways[number:])
        yield replace(way, share_s=share_s, most_s=left_s)


def listen(attempt: Attempt, listener: Listener) -> None:
    """Hear a real line."""
    setup = radio_setup(RadioConfig(name=attempt.radio), "identify")
    link = radio_link(setup, attempt.url, is_probed=True)
    ear = Ear(listener, attempt.share_s, attempt.most_s)
    Shell(ear, [link.transport], Clock()).run_blocking()


def identify(
    url: str, seconds: float = LISTEN_S, hear: Listen = listen, clock: Clocked = time.monotonic
) -> tuple[int, str]:
    """Return the exit code and what to print: the radio and the command, or what was heard."""
    heard, powers, problem = 0, 0, ""
    for attempt in timed(attempts(url), seconds, clock):
        listener = Listener()
        try:
            hear(attempt, listener)
        except CompanionError as error:
            problem = str(error)
            continue
        heard, powers = heard + listener.bytes, powers + listener.powers
        found = listener.found
        if found is not None:
            return 0, _words(found, attempt, url)
    if powers >= FEWEST_POWERS:
        return 1, f"{heard} bytes at {url}: {POWER_ONLY}"
    if not heard:
        reason = problem or "check power, cable and port, and that an emitter is on"
        return 1, f"nothing heard at {url} in {seconds:g} s: {reason}"
    return 1, f"{heard} bytes at {url}, of no radio that is known; docs/radios/any-radio.md"


def _words(found: _Candidate, attempt: Attempt, url: str) -> str:
    kind = radio_kind(found.name)
    at = url if attempt.baud is None else attempt.url
    speed = "" if attempt.baud is None else f" at {attempt.baud} baud"
    names = ", ".join(sorted(str(each) for each in found.emitters if each is not None)[:4])
    emitters = f"; emitters {names}" if names else ""
    head = f"{found.name}: {kind.title}{speed}, gives {kind.gives}{emitters}"
    if _needs_tag(kind) and not found.readings:
        hint = "NAME is the address of the other one"
        return f"{head}\ncompanion radio watch '{found.name}:tag=NAME@{at}'  # {hint}"
    return f"{head}\ncompanion radio watch '{found.name}@{at}'"


def _needs_tag(kind: RadioKind) -> bool:
    """Return True if it asks only for an emitter that is configured."""
    return isinstance(kind.poll, Poll) and bool(kind.poll.probe)
