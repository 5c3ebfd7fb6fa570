"""KrakenSDR's suite of 2026 by its web socket: the spectrum of directions, five times a second.

Source: krakenrf/krakensdr_suite, `kraken_doa_v2/NATIVE_APP_API.md`, section 5, and for peak and
confidence `music_processor.cpp`. Binary messages are little-endian behind a type: 3 has the
directions of each channel by its offset from the centre frequency, which type 0 has in the head of
its picture of the band (the rest is skipped). The angle of the spectrum is counter-clockwise. Text
messages contain, among much else, the antenna arrangement.

While the squelch is closed, or the receiver calibrates, the last spectrum is repeated. A repeated
spectrum is not a measurement, so that a lost signal is noticed at once.
"""

from __future__ import annotations

import math
import re
import struct
import zlib
from typing import Annotated

import msgspec

from companion.radios.decoder import RadioReading
from companion.radios.kraken import FIRST_EPOCH_MS, KrakenDecoder, KrakenOptions, Result

TEXT, BINARY = 0x81, 0x82
"""First byte of a whole frame of RFC 6455 from a server."""
BAND, AUDIO, DIRECTIONS, BEAM = 0, 1, 3, 4
"""Types of binary messages."""
BAND_HEAD = struct.Struct("<IIIfffII")
"""Type, channels, decimation, centre in MHz, gain, averaging, marker, bins."""
BAND_BIN_BYTES = 6
FIRST_WIDE_MARKER = 0xFE
"""Smallest marker of a spectrum of several tuners, whose centre belongs to none of them."""
AUDIO_HEAD = struct.Struct("<IIfI")
CHANNEL = struct.Struct("<IfIIfIf")
"""Id, offset in kHz, bandwidth, angles, radius, blocks, degrees an angle."""
WORD, ELEVATION = struct.Struct("<I"), struct.Struct("<Ifi")
LONGEST, LONGEST_LINE, MAX_CHANNELS, MAX_ANGLES = 60_000, 4096, 16, 3600
BEST_RATIO = 3.0
"""Peak over mean of the spectrum, less 1, that the suite calls a confidence of 1."""


class KrakenSocketOptions(KrakenOptions, frozen=True):
    """Settings of the socket in addition to those of every KrakenSDR."""

    token: Annotated[str, msgspec.Meta(pattern="^[A-Za-z0-9]{0,128}$")] = ""
    """Token from `KRAKEN_API_TOKEN` or the file `api_token` of the receiver; empty if none."""


class KrakenSocketDecoder(KrakenDecoder):
    """Decoder of frames of directions, and of the band for its centre frequency."""

    Options = KrakenSocketOptions
    options: KrakenSocketOptions
    may_be_unsettled = False  # while it tunes and calibrates the last spectrum is repeated
    _START = re.compile(rb"[\x81\x82{]")
    _TOPOLOGY = re.compile(rb'^\{"sync_cmd":"TOPOLOGY:([A-Z]{2,8})"')
    _KNOWN = re.compile(rb'^\{"[a-z_]{3,32}":')

    def begin(self) -> None:
        """Begin without a partial frame; another receiver may answer."""
        super().begin()
        self._rest, self._skip = b"", 0
        self._centre_hz: float | None = None
        self._is_line_array = False

    def hello(self) -> bytes:
        """Send the token, if there is one, and request the two kinds of frames."""
        token = f"AUTH:{self.options.token}\n" if self.options.token else ""
        return f"{token}SUBSCRIBE:FFT,DOA\n".encode()

    def feed(self, data: bytes, received_s: float) -> list[RadioReading]:
        """Return the readings of the frames that some bytes complete."""
        readings: list[RadioReading] = []
        data, at = self._rest + data, 0
        while at < len(data):
            skipped = min(self._skip, len(data) - at)
            at, self._skip = at + skipped, self._skip - skipped
            found = self._START.search(data, at)
            start = len(data) if found is None else found.start()
            self.counts.resync_bytes += start - at
            at = start
            if found is None:
                break
            size, head = self._size_at(data, at)
            if size is None or at + size > len(data):
                break
            read = self._read(data[at + head : at + size], received_s) if size else None
            if read is None:
                self.counts.resync_bytes += 1
                at += 1
                continue
            readings += read
            at += size
        self._rest = data[at:]
        self.counts.readings += len(readings)
        return readings

    def _size_at(self, data: bytes, at: int) -> tuple[int | None, int]:
        """Return the sizes of the frame or line there, and of its head.

        A size of 0 means no frame; None that more bytes are needed. Of a picture of the band only
        the head is a frame; the rest is skipped.
        """
        if data[at] == ord("{"):
            end = data.find(b"\n", at, at + LONGEST_LINE)
            if end < 0:
                return (None if len(data) - at < LONGEST_LINE else 0), 0
            return end + 1 - at, 0
        if len(data) < at + 2:
            return None, 0
        short = data[at + 1]
        head = 2 if short < 126 else 4 if short == 126 else 10
        if short > 127 or len(data) < at + head + WORD.size:
            return (0 if short > 127 else None), 0
        length = short if head == 2 else int.from_bytes(data[at + 2 : at + head], "big")
        if data[at] == TEXT:
            is_object = data[at + head] == ord("{") and 0 < length <= LONGEST_LINE
            return (head + length if is_object else 0), head
        (kind,) = WORD.unpack_from(data, at + head)
        if kind == DIRECTIONS:
            return (head + length if 2 * WORD.size <= length <= LONGEST else 0), head
        shown = {BAND: BAND_HEAD.size, BEAM: BAND_HEAD.size, AUDIO: AUDIO_HEAD.size}.get(kind)
        if shown is None or length < shown:
            return 0, 0
        if len(data) < at + head + shown:
            return None, 0
        last = WORD.unpack_from(data, at + head + shown - WORD.size)[0]
        if length != shown + last * (1 if kind == AUDIO else BAND_BIN_BYTES):
            return 0, 0
        self._skip = length - shown
        return head + shown, head

    def _read(self, body: bytes, now_s: float) -> list[RadioReading] | None:
        """Return the readings of a line, or of a frame without its head; None if it is neither."""
        if body.startswith(b"{"):
            return self._text(body)
        (kind,) = WORD.unpack_from(body)
        if kind != DIRECTIONS:
            self.counts.frames += 1
            if kind == BAND:
                self._tune(body)
            return []
        channels = _channels_of(body)
        if channels is None:
            return None
        if self._centre_hz is None:
            self.counts.frames += 1
            self.counts.refuse("frequency is not known yet")
            return []
        time_ms = FIRST_EPOCH_MS + 1000.0 * now_s
        readings: list[RadioReading] = []
        for offset_hz, step_deg, spectrum in channels:
            peak = _peak_of(spectrum, step_deg)
            result: Result | str = "no direction in the spectrum"
            if peak is not None:
                result = Result(
                    time_ms,
                    -peak[0] % 360.0,
                    peak[1],
                    self._centre_hz + offset_hz,
                    0.0,
                    is_line_array=self._is_line_array,
                    checksum=zlib.crc32(struct.pack(f"<{len(spectrum)}f", *spectrum)),
                )
            readings += self.readings_of(result, now_s)
        return readings

    def _tune(self, body: bytes) -> None:
        _, channels, _, centre_mhz, _, _, marker, bins = BAND_HEAD.unpack(body)
        is_one = marker < FIRST_WIDE_MARKER and channels and bins and math.isfinite(centre_mhz)
        self._centre_hz = 1e6 * centre_mhz if is_one else None

    def _text(self, line: bytes) -> list[RadioReading] | None:
        if not self._KNOWN.match(line):
            return None
        self.counts.frames += 1
        arrangement = self._TOPOLOGY.match(line)
        if arrangement is not None:
            self._is_line_array = arrangement[1] == b"ULA"
        elif line.startswith(b'{"auth_error"'):
            self.counts.refuse("the receiver refuses the token")
        elif line.startswith(b'{"auth_required"') and not self.options.token:
            self.counts.refuse("the receiver asks for a token: set the option `token`")
        return []


def _channels_of(body: bytes) -> list[tuple[float, float, tuple[float, ...]]] | None:
    """Return offset in Hz, degrees per bin and spectrum of each; None if the frame is not full."""
    count = WORD.unpack_from(body, WORD.size)[0] if len(body) >= 2 * WORD.size else 0
    at, channels = 2 * WORD.size, []
    if not 0 < count <= MAX_CHANNELS:
        return None
    for _ in range(count):
        if at + CHANNEL.size > len(body):
            return None
        _, offset_khz, _, angles, _, _, step_deg = CHANNEL.unpack_from(body, at)
        at += CHANNEL.size
        end = at + 4 * angles + WORD.size
        if not 0 < angles <= MAX_ANGLES or end > len(body):
            return None
        spectrum = struct.unpack_from(f"<{angles}f", body, at)
        at = end
        if WORD.unpack_from(body, end - WORD.size)[0]:
            if at + ELEVATION.size > len(body):
                return None
            at += ELEVATION.size + 4 * ELEVATION.unpack_from(body, at)[0]
        channels.append((1000.0 * offset_khz, step_deg, spectrum))
    return channels if at == len(body) else None


def _peak_of(spectrum: tuple[float, ...], step_deg: float) -> tuple[float, float] | None:
    """Return angle in degrees and confidence as the suite computes them; None without a peak."""
    count, peak = len(spectrum), max(spectrum)
    mean = sum(spectrum) / count
    if not (math.isfinite(mean) and peak > 0.0 and mean > 0.0 and 0.0 < step_deg <= 360.0):
        return None
    at = spectrum.index(peak)
    shift = _shift_of_peak(spectrum[at - 1], peak, spectrum[(at + 1) % count])
    return step_deg * (at + shift), min(1.0, (peak / mean - 1.0) / BEST_RATIO)


def _shift_of_peak(before: float, peak: float, after: float) -> float:
    """Return the peak's position between two bins: the top of a parabola through logarithms."""
    if before <= 0.0 or after <= 0.0:
        return 0.0
    left, middle, right = map(math.log, (before, peak, after))
    curve = left - 2.0 * middle + right
    return 0.0 if curve >= 0.0 else 0.5 * (left - right) / curve
