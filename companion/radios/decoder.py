"""Interface of every decoder of a radio's own format: bytes and time in, readings out.

Theory of operation. A decoder knows one format and nothing else. It returns the radio's values in
the radio's own convention: the emitter by its name on the wire, the device's own time, angles with
the device's own sign and zero. Everything else is common and done once, in
`companion.link.radio_stage`: names to ids, offset and scale, sign, mount, clocks, repeated or stale
values. So a new radio is one class here, which needs no frame of reference.

A decoder never raises on bytes from a radio. It counts unusable ones by reason. Its memory between
two calls is bounded, and how the stream is cut into pieces makes no difference.

Radios are found by name: built-in ones, and those of installed packages.

A radio is imported only when it is chosen, so a broken plugin harms only its users.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from enum import Enum
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from importlib.resources import files
from re import Pattern
from typing import Any

import msgspec

from companion.domain import Params
from companion.errors import ConfigError

MAX_KEPT_BYTES = 65_536
"""Maximum number of bytes of a stream that a decoder keeps between two calls."""
MAX_SHOWN = 80
"""Characters of a line that is shown."""
MAX_REASONS = 32
"""Number of reasons counted separately; further ones count as `other`."""
POWER_ONLY = "received power only: rssi, lora_gateway and uavrt read it (docs/radios.md)"
_POWER = re.compile(
    r"-\d{1,3}(?:\.\d+)? ?dBm\b"
    r"|\b(?:rx[ _]?)?(?:rssi|rssi_dbm|rss|signal|signal level|power_dbm|power_db|lsnr|snr|snr_db)\b"
    r"\W{1,16}-?\d",
    re.IGNORECASE,
)
_MEASURED = re.compile(
    r"\d ?(?:m|cm|mm|km|ft|ns|ps|deg|rad|meters?)\b|\N{DEGREE SIGN}"
    r"|(?<![a-z])(?:dist(?:ance)?|rang(?:e|es|ing)|rtt|tof|bearing|azimuth|elevation|angles?|doa)"
    r"(?:[mc]?m|deg|rad)?(?![a-z])|_(?:[mc]?m|deg|rad)[\"']?\s?[:=]",
    re.IGNORECASE,
)
"""Other quantities, as words, because names of networks hold anything: a line with one of them is
of an unknown format, and is counted as that."""


def is_power_only(line: str) -> bool:
    """Return True if a line has a received power, and no range or angle by any name."""
    return _POWER.search(line) is not None and _MEASURED.search(line) is None


class AngleFrame(Enum):
    """Zero direction of a reading's angles."""

    DEVICE = "device"
    """The antenna's boresight; the angles are azimuth and elevation about its upright."""
    ARRAY = "array"
    """The antenna's boresight; each angle is the arcsine of a component in the array's plane."""
    NOSE = "nose"
    """Angles are clockwise from the vehicle's nose."""
    NORTH = "north"
    """Angles are clockwise from true north."""


@dataclass(frozen=True, slots=True)
class RadioReading:
    """One reading of an emitter as its radio reports it; None for values that were not measured."""

    emitter: str | int | None = None
    """Emitter by its name on the wire; None if the format has none."""
    device_time_s: float | None = None
    """Device's own clock as on the wire: it may wrap, or restart."""
    age_s: float = 0.0
    """Age at sending, if the device reports it."""
    range_m: float | None = None
    """Range as reported, before any offset or scale; may be negative."""
    range_sigma_m: float | None = None
    azimuth_rad: float | None = None
    """Azimuth with the device's sign."""
    azimuth_sigma_rad: float | None = None
    elevation_rad: float | None = None
    elevation_sigma_rad: float | None = None
    power_dbm: float | None = None
    frame: AngleFrame = AngleFrame.DEVICE
    quality: float | None = None
    """Quality of the reading, 0 (worst) to 1 (best)."""
    line_of_sight: bool | None = None


@dataclass(slots=True)
class DecoderCounts:
    """Counters of a decoder's stream so far."""

    frames: int = 0
    """Whole frames, lines or documents that were understood, with readings in them or not."""
    readings: int = 0
    bad_checksum: int = 0
    resync_bytes: int = 0
    """Bytes that belonged to no frame."""
    refused: Counter[str] = field(default_factory=Counter)
    """Number of refused readings by reason: `no bearing from above`, `status RX_TIMEOUT`."""
    unrecognised: int = 0
    """Lines that are not in the format; blank ones do not count."""
    first_unrecognised: str = ""
    """First unrecognised line, truncated and printable."""
    is_introduced: bool = False
    """True once the module has named itself, in answer to the kind's probe."""

    def pass_over(self, line: str) -> None:
        """Count a line that is not of the format, and separately one of received power."""
        self.resync_bytes += len(line.encode(errors="replace"))
        if is_power_only(line):
            self.refuse(POWER_ONLY)
        elif line.strip():
            self.unrecognised += 1
            shown = line.strip()[:MAX_SHOWN]
            shown = "".join(char if char.isprintable() else "?" for char in shown)
            self.first_unrecognised = self.first_unrecognised or shown

    def refuse(self, reason: str, count: int = 1) -> None:
        """Count an unusable frame. The reason must not hold bytes of the stream."""
        if reason not in self.refused and len(self.refused) >= MAX_REASONS:
            reason = "other"
        self.refused[reason] += count


@dataclass(frozen=True, slots=True)
class Poll:
    """Query for a radio that reports only when asked."""

    path: str
    """Path for HTTP if the link's address has none."""
    period_s: float
    request: bytes = b""
    """Query over a serial port or TCP, sent each period."""
    probe: bytes = b""
    """Query for the module's own name, for one whose requests need a configured address."""


class RadioDecoder(ABC):
    """Decoder of one radio's stream; `options` is a record of the class's own `Options`."""

    Options: type[Params] = Params
    """The settings that the format itself needs; unknown keys are refused by their path."""

    def __init__(self, options: Params | None = None) -> None:
        self.options = self.Options() if options is None else options
        self.counts = DecoderCounts()
        self.begin()

    def begin(self) -> None:  # noqa: B027 -- most keep nothing
        """Set what is kept of the stream to that of a line that was opened just now."""

    @abstractmethod
    def feed(self, data: bytes, received_s: float) -> list[RadioReading]:
        """Return the readings completed at `received_s`, however bytes are cut; never raises."""

    def reset(self) -> None:
        """Forget a partial frame, because the line was lost and came back."""
        self.begin()

    def hello(self) -> bytes:
        """Return the bytes that start the radio's output, sent once the link is open."""
        return b""

    def request(self) -> bytes:
        """Return the periodic query if it depends on the options; empty: the kind's own query."""
        return b""


@dataclass(frozen=True, slots=True)
class RadioKind:
    """Radio that can be chosen by its name: a built-in one, or a plugin's."""

    name: str
    """Name as in `--radio NAME@URL`: lower case, digits and underscores."""
    decoder: type[RadioDecoder]
    title: str
    """Title for people: `Nooploop LinkTrack and LinkTrack AOA`."""
    gives: str
    """`range`, `bearing`, `range, azimuth, elevation`."""
    emitter: str
    """Device that the hidden person must carry, such as `a LinkTrack tag`."""
    transport: str = "serial:115200"
    """The usual one, as in an address: `serial:115200`, `http`, `exec`, `udp`."""
    needs_offset: bool = False
    """True if its ranges have an offset of the single device that may be longer than the search:
    without `range_offset_m` or `offset_steps` nothing is localised."""
    clock_wrap_s: float | None = None
    """Period after which the device's clock restarts at zero; None if it never does."""
    poll: Poll | None = None
    """Query for a radio that does not report by itself."""
    defaults: Mapping[str, object] = field(default_factory=dict)
    """Defaults of the common stage for this radio, `bearing_sign` for example."""


class LineDecoder(RadioDecoder):
    """Decoder of text that cuts the stream into lines.

    A line ends with LF, CR or CRLF in any cut; one beyond `longest_line` is dropped whole and
    counted. Bytes that are not text are replaced, so that a line is always a `str`; a byte order
    mark, and colours, cursor movements and titles of a terminal are removed, as is, without
    `has_stamps`, the stamp that a terminal or a logger prints before each line.
    """

    longest_line = 4096
    has_stamps: bool = True
    """True if a stamp before a line may be part of the format, as in a plugin's; it stays there."""
    _LINE_END = re.compile(rb"\r\n?|\n")
    _STAMP = re.compile(
        r"(?:\[(?:[0-9]{4}-[0-9]{2}-[0-9]{2}[ T])?[0-9]{2}:[0-9]{2}:[0-9]{2}"
        r"(?:[.,][0-9]{1,9}){0,2}\]"
        r"(?: <[a-z]{3}> [\w.-]{1,40}:)? ?"
        r"|\[ {0,10}[0-9]{1,10}\.[0-9]{3,9}\] ?"
        r"|[0-9]{2}-[0-9]{2} [0-9:]{8}\.[0-9]{3} +[0-9]+ +[0-9]+ [VDIWEF] [^ :]{1,40} {0,20}: "
        r"|[0-9]{4}-[0-9]{2}-[0-9]{2}[ T][0-9]{2}:[0-9]{2}:[0-9]{2}(?:[.,][0-9]{1,9})?"
        r"(?:Z|[+-][0-9]{2}:?[0-9]{2})?:? "
        r"|[A-Z][a-z]{2} [ 0-9][0-9] [0-9]{2}:[0-9]{2}:[0-9]{2}(?:\.[0-9]{1,9})? "
        r"(?:[\w.-]{1,64} [\w./-]{1,64}\[[0-9]{1,10}\]: )?"
        r"|[0-9]{2}:[0-9]{2}:[0-9]{2}(?:[.:][0-9]{1,9})? (?:-?> )?"
        r"|[0-9]{10}\.[0-9]{3,9}:? )?"
        r"(?:[EWIDV] \([0-9:.]{1,12}\) [\w.-]{1,40}: )?(?![,;|])"
    )
    """Stamps of minicom, tio, `ts`, CoolTerm, the monitors of Arduino and PlatformIO, the kernel,
    journals, logcat, Zephyr, and behind any of these that of ESP-IDF."""
    _ESCAPES = re.compile(
        r"\A[\ufeff\0]+|\x1b\[[0-?]*[ -/]*[@-~]|\x1b\][^\x07\x1b]*(?:\x07|\x1b\\)?"
        r"|\x1b[()*+][0-9A-Za-z]|\x1b[=>78cDEHM]|[\x01\x02]"
    )
    """The mark, ANSI sequences (ECMA-48), and readline's marks about them."""

    def begin(self) -> None:
        """Begin without a partial line."""
        super().begin()
        self._rest = b""
        self._is_overlong = self._is_after_cr = False

    @abstractmethod
    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """Return the readings that a line completes."""

    def feed(self, data: bytes, received_s: float) -> list[RadioReading]:
        """Cut into lines, and read each."""
        readings: list[RadioReading] = []
        if self._is_after_cr and data.startswith(b"\n"):
            data, self._is_after_cr = data[1:], False
        if data:
            self._is_after_cr = data.endswith(b"\r")
        *lines, rest = self._LINE_END.split(self._rest + data)
        for line in lines:
            if self._is_overlong or len(line) > self.longest_line:
                self._drop(len(line))
                self._is_overlong = False
                continue
            text = self._ESCAPES.sub("", line.decode("utf-8", errors="replace"))
            stamp = None if self.has_stamps else self._STAMP.match(text)
            readings += self.read_line(text[stamp.end() :] if stamp else text, received_s)
        if self._is_overlong or len(rest) > self.longest_line + 1:
            self._drop(len(rest))
            self._is_overlong = True
            rest = b""
        self._rest = rest
        self.counts.readings += len(readings)
        return readings

    def _drop(self, count: int) -> None:
        self.counts.resync_bytes += count
        if not self._is_overlong:
            self.counts.refuse("line is too long")


class FrameDecoder(RadioDecoder):
    """Decoder of binary frames; of bytes that are none only the first is skipped."""

    start: Pattern[bytes]
    """Pattern of a frame's beginning, also when the end of the data cuts it off."""

    def begin(self) -> None:
        """Begin without a partial frame."""
        super().begin()
        self._rest = b""

    @abstractmethod
    def size_at(self, data: bytes, at: int) -> int | None:
        """Return the size of the frame there, fixed whatever follows; 0: none, None: needs more."""

    @abstractmethod
    def read_frame(self, frame: bytes) -> list[RadioReading] | None:
        """Return the readings of a frame; None if it is invalid (a wrong checksum is counted)."""

    def feed(self, data: bytes, received_s: float) -> list[RadioReading]:
        """Cut into frames, and read each."""
        readings: list[RadioReading] = []
        data, at = self._rest + data, 0
        search, counts = self.start.search, self.counts
        while found := search(data, at):
            counts.resync_bytes += found.start() - at
            at = found.start()
            size = self.size_at(data, at)
            if size is None or at + size > len(data):
                break
            read = self.read_frame(data[at : at + size]) if size else None
            if read is None:
                counts.resync_bytes += 1
                at += 1
                continue
            counts.frames += 1
            readings += read
            at += size
        else:
            counts.resync_bytes += len(data) - at
            at = len(data)
        self._rest = data[at:]
        counts.readings += len(readings)
        return readings


GROUP = "companion.radios"
"""The entry-point group of plugins: the radio's name to `module:ATTRIBUTE` of its `RadioKind`."""

BUILT_IN: Mapping[str, Mapping[str, Any]] = msgspec.yaml.decode(
    files("companion.radios").joinpath("kinds.yaml").read_bytes()
)
"""The fields of each `RadioKind`, by its name."""


def known_radios() -> dict[str, str]:
    """Return every radio name and its origin, `built in` or a package, broken ones too."""
    plugins = {point.name: _package(point) for point in entry_points(group=GROUP)}
    return {name: "built in" for name in BUILT_IN} | {
        name: package for name, package in sorted(plugins.items()) if name not in BUILT_IN
    }


def radio_kind(name: str) -> RadioKind:
    """Return the radio of a name, built-in first; `ConfigError`: unknown, or a broken plugin."""
    if name in BUILT_IN:
        return _built_in(name)
    points = list(entry_points(group=GROUP, name=name))
    if not points:
        near = get_close_matches(name, known_radios(), n=1)
        hint = f"did you mean {near[0]}? " if near else ""
        raise ConfigError(f"radio {name}: no such radio; {hint}`companion radio list` has them all")
    if len(points) > 1:
        packages = " and ".join(sorted(_package(point) for point in points))
        raise ConfigError(f"radio {name}: both {packages} have it; uninstall one of them")
    return _of_plugin(points[0])


@cache
def _built_in(name: str) -> RadioKind:
    """Return a kind by its row, in which a polled radio's bytes are text and lists are tuples."""
    row = dict(BUILT_IN[name])
    decoder = EntryPoint(name, f"companion.radios.{row.pop('decoder')}", GROUP).load()
    poll = {
        key: value.encode("latin-1") if key in ("request", "probe") else value
        for key, value in row.pop("poll", {}).items()
    }
    defaults = {
        key: tuple(map(tuple, value)) if isinstance(value, list) else value
        for key, value in row.pop("defaults", {}).items()
    }
    return RadioKind(
        name, decoder, poll=Poll(**{"path": "", **poll}) if poll else None, defaults=defaults, **row
    )


def _of_plugin(point: EntryPoint) -> RadioKind:
    """Load a plugin's entry point. Raises a `ConfigError` in one line that names it."""
    plugin = f"radio {point.name}: the plugin {_package(point)} ({point.value})"
    try:
        kind = point.load()
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise ConfigError(
            f"{plugin} cannot be imported: {reason}; repair or uninstall it"
        ) from error
    if not isinstance(kind, RadioKind):
        raise ConfigError(
            f"{plugin} is a {type(kind).__name__}; its entry point must lead to a RadioKind"
        )
    if kind.name != point.name:
        raise ConfigError(
            f"{plugin} calls itself {kind.name}; its entry point must have the same name"
        )
    return kind


def _package(point: EntryPoint) -> str:
    return "of an unknown package" if point.dist is None else point.dist.name
