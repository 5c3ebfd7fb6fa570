"""`companion radio identify @URL`: which radio it is that talks there, and what to type for it.

Every built-in decoder reads the same bytes; the one that understands most of them has it. Noise is
understood by none: a decoder must read several measurements, and one of binary frames most bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import msgspec

from companion.config.radios import RadioConfig, radio_setup
from companion.errors import CompanionError
from companion.io.links.radio_lines import radio_link
from companion.io.shell import Clock, Shell
from companion.mav.endpoint import Chunk, OneShotEndpoint
from companion.radios.catalogue import BUILT_IN, radio_kind
from companion.radios.decoder import FrameDecoder, RadioDecoder

LISTEN_S = 10.0
BAUDS = (115_200, 921_600, 57_600, 9_600)
"""Those of the built-in radios and of what their makers offer beside, the usual one first."""
FEWEST = 2
"""Readings: a single one may be chance, and slow radios give one or two in the time."""
FEWEST_FRAMES_SHARE = 0.5
"""Of the bytes, in binary formats, whose short frames without a checksum occur in noise."""
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
        for candidate in self.candidates:
            candidate.feed(data, now_s)

    @property
    def found(self) -> _Candidate | None:
        """The radio, if one understands enough; the one with the fewest bytes left over."""
        fitting = [each for each in self.candidates if self._is_fitting(each)]
        return min(fitting, key=_left_over, default=None)

    def _is_fitting(self, candidate: _Candidate) -> bool:
        if candidate.readings < FEWEST:
            return False
        read = 1.0 - candidate.decoder.counts.resync_bytes / max(1, self.bytes)
        return read >= FEWEST_FRAMES_SHARE or not isinstance(candidate.decoder, FrameDecoder)


def _left_over(candidate: _Candidate) -> tuple[int, int, int]:
    counts = candidate.decoder.counts
    return (counts.resync_bytes, counts.refused.total(), -candidate.readings)


class _Ear(OneShotEndpoint):
    """Hears one line for a while, or until it is clear who talks."""

    def __init__(self, listener: Listener, end_s: float) -> None:
        super().__init__(end_s)
        self.listener = listener

    @property
    def is_finished(self) -> bool:
        """Return True at the end, or once the radio has been found."""
        return super().is_finished or self.listener.found is not None

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Take in what arrived."""
        super().receive(chunk, now_s)
        self.listener.feed(chunk.data, now_s)


@dataclass(frozen=True, slots=True)
class Attempt:
    """One way to listen: as which radio, where, for how long."""

    radio: str
    url: str
    baud: int | None
    seconds: float


def attempts(url: str, seconds: float) -> list[Attempt]:
    """The ways to listen at a URL, in order: speeds of a serial port, pages of a host."""
    head = url.partition(":")[0].lower()
    if url.startswith("/") or head == "serial":
        device, _, given = url.removeprefix("serial:").partition(":")
        bauds = [int(given)] if given.isdigit() else list(BAUDS)
        asked = [
            name
            for name in BUILT_IN
            if (kind := radio_kind(name)).poll is not None and kind.poll.request
        ]
        each_s = seconds / (len(bauds) + len(asked))
        heard = [Attempt("ndjson", f"serial:{device}:{baud}", baud, each_s) for baud in bauds]
        return heard + [
            Attempt(name, f"serial:{device}:{bauds[0]}", bauds[0], each_s) for name in asked
        ]
    if head in ("http", "https"):
        pages = [n for n in BUILT_IN if radio_kind(n).transport.startswith("http")]
        return [Attempt(name, url, None, seconds / len(pages)) for name in pages]
    asked = [n for n in BUILT_IN if (p := radio_kind(n).poll) is not None and p.request]
    asked = asked if head.startswith("tcp") else []
    each_s = seconds / (1 + len(asked))
    return [Attempt(name, url, None, each_s) for name in ("ndjson", *asked)]


Listen = Callable[[Attempt, Listener], None]


def listen(attempt: Attempt, listener: Listener) -> None:
    """Hear a real line."""
    setup = radio_setup(RadioConfig(name=attempt.radio), "identify")
    link = radio_link(setup, attempt.url)
    Shell(_Ear(listener, attempt.seconds), [link.transport], Clock()).run_blocking()


def identify(url: str, seconds: float = LISTEN_S, hear: Listen = listen) -> tuple[int, str]:
    """Return the exit code and what to print: the radio and the command, or what was heard."""
    heard, problem = 0, ""
    for attempt in attempts(url, seconds):
        listener = Listener()
        try:
            hear(attempt, listener)
        except CompanionError as error:
            problem = str(error)
            continue
        heard += listener.bytes
        found = listener.found
        if found is not None:
            return 0, _words(found, attempt, url)
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
    return (
        f"{found.name}: {kind.title}{speed}, gives {kind.gives}{emitters}\n"
        f"companion radio watch '{found.name}@{at}'"
    )
