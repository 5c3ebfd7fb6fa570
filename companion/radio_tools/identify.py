"""`companion radio identify @URL`: recognises a radio and prints the command that uses it.

Every built-in decoder reads the same bytes; the one that understands most of them wins. Noise must
match none: a decoder has to read several measurements, and one of binary frames most bytes.

Theory of operation. The time is divided among attempts to listen: the speeds of a serial port, the
modules that must be asked, the pages of a host. An attempt with a measurement is kept until the
time is over; one with only garbage ends early, and its remaining time goes to the others. So the
whole never takes longer than requested.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import msgspec

from companion.config.radios import RadioConfig, radio_setup
from companion.errors import CompanionError
from companion.io.links.transports import radio_link
from companion.io.shell import Clock, Shell
from companion.mav.endpoint import Chunk, OneShotEndpoint
from companion.radios.decoder import (
    BUILT_IN,
    POWER_ONLY,
    FrameDecoder,
    Poll,
    RadioDecoder,
    radio_kind,
)

LISTEN_S = 10.0
BAUDS = (115_200, 921_600, 57_600, 9_600)
"""Baud rates of the built-in radios and of their variants, the usual one first."""
FEWEST = 2
"""Minimum number of readings: one may be chance, and slow radios give one or two in the time."""
HEARD_SHARES = (3.0, 1.5, 0.75, 0.75)
"""Share of the time for each of those speeds: slow radios are text, the second is fast."""
ASKED_SHARE = 1.0
"""Share of the time for each radio that is polled."""
PLAYED = "?play=10"
"""URL option that plays a file that may be a log at a hundred lines a second."""
GARBAGE_BYTES, GARBAGE_SHARE = 1000, 0.5
"""Number of bytes, and their share of non-text, that mean another speed if there is no reading."""
MIN_POWERS = 3
"""Minimum number of received powers: fewer may be by-products of a console that prints ranges."""
MIN_FRAMES_SHARE = 0.5
"""Minimum share of bytes in binary formats: short frames without a checksum occur in noise."""
UNPARSED = frozenset(
    {"torn line", "torn row", "not JSON", "no azimuth and elevation", POWER_ONLY}
    | {"row without a header that has a distance"}
)
"""Reasons to refuse a line that may be of any format."""
TEXT = bytes((*b"\t\n\r\x1b", *range(0x20, 0x7F)))
NO_LINES = ("lines",)
"""Radios without a format of their own."""
OPTIONS: Mapping[str, Mapping[str, object]] = {
    "srsran": {"loop_is_off": True, "numerology": 1},
    "oai": {"numerology": 1},
    "android_rtt": {"unit": "mm", "single_emitter": True},
    "rssi": {"single_emitter": True},
}
"""Options with which any stream of a format yields readings."""


@dataclass(slots=True)
class _Candidate:
    """A built-in radio whose decoder reads the stream."""

    name: str
    decoder: RadioDecoder
    plain: RadioDecoder | None = None
    """The same without the options; None if there are none."""
    readings: int = 0
    powers: int = 0
    """Readings with a received power alone."""
    emitters: set[str | int | None] = field(default_factory=set)

    def feed(self, data: bytes, now_s: float) -> None:
        """Decode some bytes."""
        if self.plain is not None:
            self.plain.feed(data, now_s)
        found = self.decoder.feed(data, now_s)
        powers = sum(each.range_m is None and each.azimuth_rad is None for each in found)
        self.powers += powers
        self.readings += len(found) - powers
        self.emitters.update(reading.emitter for reading in found[:16])

    @property
    def refused(self) -> dict[str, int]:
        """Return the number of refused readings by reason, without lines of unknown format."""
        counts = self.decoder.counts.refused.most_common()
        return {reason: count for reason, count in counts if reason not in UNPARSED}

    @property
    def needed(self) -> dict[str, object]:
        """Return the options without which fewer readings result."""
        if self.plain is None or self.plain.counts.readings >= self.decoder.counts.readings:
            return {}
        is_named = any(emitter is not None for emitter in self.emitters)
        options = OPTIONS[self.name].items()
        return {key: each for key, each in options if not (is_named and key == "single_emitter")}


class Listener:
    """All candidates on one stream."""

    def __init__(self, names: Sequence[str] = tuple(BUILT_IN)) -> None:
        self.bytes = 0
        self._no_text = 0
        self.candidates = [
            _Candidate(name, kind.decoder(options), kind.decoder() if name in OPTIONS else None)
            for name in names
            if name not in NO_LINES
            for kind in [radio_kind(name)]
            for options in [msgspec.convert(OPTIONS.get(name, {}), kind.decoder.Options)]
        ]

    def feed(self, data: bytes, now_s: float) -> None:
        """Decode some bytes with every candidate."""
        self.bytes += len(data)
        self._no_text += len(data.translate(None, TEXT))
        for candidate in self.candidates:
            candidate.feed(data, now_s)

    @property
    def found(self) -> _Candidate | None:
        """Return the radio that understands enough, with the fewest bytes left over; or None."""
        fitting = [each for each in self.candidates if self._is_fitting(each, FEWEST)]
        return min(fitting, key=_left_over, default=None)

    @property
    def found_by_power(self) -> _Candidate | None:
        """Return the radio that reads most powers, once nothing else is to be expected; or None.

        Any log may mention a power now and then: most lines must be from that radio.
        """
        fitting = [
            each
            for each in self.candidates
            if each.powers >= MIN_POWERS
            and self._is_mostly_read(each)
            and each.decoder.counts.unrecognised <= each.decoder.counts.frames
        ]
        return min(fitting, key=_left_over, default=None)

    @property
    def refusing(self) -> _Candidate | None:
        """Return the radio whose output this is, although it refuses the measurements; or None."""
        fitting = [
            each
            for each in self.candidates
            if sum(each.refused.values()) >= max(FEWEST, each.decoder.counts.frames / 2)
            and each.decoder.counts.frames
            and each.decoder.counts.resync_bytes < MIN_FRAMES_SHARE * self.bytes
        ]
        return min(fitting, key=_left_over, default=None)

    @property
    def is_promising(self) -> bool:
        """Return True if something was measured, or its power: the radio may be a slow one."""
        is_heard = self.found_by_power is not None
        return is_heard or any(self._is_fitting(each, 1) for each in self.candidates)

    @property
    def is_garbage(self) -> bool:
        """Return True if much arrived that is neither text nor measurements."""
        return (
            self.bytes >= GARBAGE_BYTES
            and self._no_text > GARBAGE_SHARE * self.bytes
            and not self.is_promising
        )

    def _is_fitting(self, candidate: _Candidate, fewest: int) -> bool:
        counts = candidate.decoder.counts
        if counts.is_introduced:
            return True
        return candidate.readings >= fewest and self._is_mostly_read(candidate)

    def _is_mostly_read(self, candidate: _Candidate) -> bool:
        read = 1.0 - candidate.decoder.counts.resync_bytes / max(1, self.bytes)
        return read >= MIN_FRAMES_SHARE or not isinstance(candidate.decoder, FrameDecoder)


def _left_over(candidate: _Candidate) -> tuple[int, int, int]:
    counts = candidate.decoder.counts
    readings = candidate.readings + candidate.powers
    return (counts.resync_bytes, counts.refused.total(), -readings)


class RadioListener(OneShotEndpoint):
    """Listens to one link until the radio is recognised or the attempt's time is over."""

    def __init__(self, listener: Listener, share_s: float, most_s: float) -> None:
        super().__init__(most_s)
        self.listener = listener
        self._share_s = share_s

    @property
    def is_finished(self) -> bool:
        """Return True when the time is over, the radio is recognised, or only garbage arrives."""
        listener = self.listener
        if super().is_finished or listener.found is not None or listener.is_garbage:
            return True
        return self.now_s >= self._share_s and not listener.is_promising

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Decode received bytes."""
        super().receive(chunk, now_s)
        self.listener.feed(chunk.data, now_s)


@dataclass(frozen=True, slots=True)
class Attempt:
    """One attempt to listen: radio, address and duration."""

    radio: str
    url: str
    baud: int | None = None
    share: float = 1.0
    """Share of the time, relative to the other attempts' shares."""
    share_s: float = 0.0
    most_s: float = 0.0
    """Longest time if something was measured; `share_s` is the time until then."""


def attempts(url: str) -> list[Attempt]:
    """Return the ways to listen at a URL, in order: speeds of a serial port, pages of a host.

    Radios that only answer are asked before the other speeds, each at its default speed. A file is
    played from its beginning, then followed as one that grows.
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
    if head == "file" and "?" not in url:  # its first lines may name the columns
        return [Attempt("ndjson", url + PLAYED), Attempt("ndjson", url)]
    names = _asked() if head.startswith("tcp") else []
    heard = [Attempt("ndjson", url, share=HEARD_SHARES[0])]
    return heard + [Attempt(name, url, share=ASKED_SHARE) for name in names]


def _asked() -> list[str]:
    """Return the radios that must be asked before they report."""
    polls = {name: radio_kind(name).poll for name in BUILT_IN}
    return [n for n, poll in polls.items() if poll is not None and (poll.request or poll.probe)]


Clocked = Callable[[], float]
Listen = Callable[[Attempt, Listener], None]


def timed(ways: Sequence[Attempt], seconds: float, clock: Clocked) -> Iterator[Attempt]:
    """Yield each attempt with its share of the remaining time."""
    end_s = clock() + seconds
    for number, way in enumerate(ways):
        left_s = max(0.0, end_s - clock())
        share_s = left_s * way.share / sum(each.share for each in ways[number:])
        yield replace(way, share_s=share_s, most_s=left_s)


def listen(attempt: Attempt, listener: Listener) -> None:
    """Listen on a real line."""
    setup = radio_setup(RadioConfig(name=attempt.radio), "identify")
    link = radio_link(setup, attempt.url, is_probed=True)
    listening = RadioListener(listener, attempt.share_s, attempt.most_s)
    Shell(listening, [link.transport], Clock()).run_whole()


def identify(
    url: str, seconds: float = LISTEN_S, hear: Listen = listen, clock: Clocked = time.monotonic
) -> tuple[int, str]:
    """Return the exit code and the report: the radio and its command, or the data received."""
    heard, has_listened, problem, refusing = 0, False, None, None
    for attempt in timed(attempts(url), seconds, clock):
        listener = Listener()
        try:
            hear(attempt, listener)
        except CompanionError as error:
            problem = error
            continue
        has_listened = True
        heard += listener.bytes
        refusing = refusing or listener.refusing
        found = listener.found or listener.found_by_power
        if found is not None:
            return 0, _words(found, attempt, url)
    if not heard:
        if problem is not None and not has_listened:
            raise problem
        reason = problem or "check power, cable and port, and that an emitter is on"
        return 1, f"nothing heard at {url} in {seconds:g} s: {reason}"
    if refusing is not None:
        reasons = ", ".join(f"{reason} {count}" for reason, count in refusing.refused.items())
        return 1, f"{heard} bytes at {url}, refused by {refusing.name}: {reasons}"
    return 1, f"{heard} bytes at {url}, from no known radio; see docs/radios/any-radio.md"


def _words(found: _Candidate, attempt: Attempt, url: str) -> str:
    kind = radio_kind(found.name)
    at = url if attempt.baud is None else attempt.url
    if attempt.url == url + PLAYED:
        at = f"{url}?play=1"
    speed = "" if attempt.baud is None else f" at {attempt.baud} baud"
    names = ", ".join(sorted(str(each) for each in found.emitters if each is not None)[:4])
    emitters = f"; emitters {names}" if names else ""
    head = f"{found.name}: {kind.title}{speed}, gives {kind.gives}{emitters}"
    options, hint = found.needed, "" if not found.needed else "  # options assumed: check them"
    if isinstance(kind.poll, Poll) and kind.poll.probe and not found.readings:
        options, hint = {"tag": "NAME"}, "  # NAME is the address of the other radio"
    pairs = ",".join(
        f"{k}={v if isinstance(v, str) else str(v).lower()}" for k, v in options.items()
    )
    return f"{head}\ncompanion radio watch '{found.name}{':' if pairs else ''}{pairs}@{at}'{hint}"
