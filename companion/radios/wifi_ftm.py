"""Printed Wi-Fi fine time measurements: the ESP32's console, Linux `iw`.

Sources: espressif/esp-idf `examples/wifi/ftm`, espressif/arduino-esp32
`libraries/WiFi/examples/FTM`; greearb/iw-ct `measurements.c`, domienschepers/wifi-ftm. Ranges are
as the radio reports them: with the chip's offset, which is metres.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Annotated

import msgspec

from companion.domain import Params
from companion.radios.decoder import RadioReading
from companion.radios.fields import ONE_WAY_M_PER_S, FieldDecoder, number, ratio

LONGEST_M = 100_000.0
"""Longest range; an unsigned distance that went below zero is far beyond it."""
MAC = re.compile(r"[0-9A-Fa-f]{2}(?::[0-9A-Fa-f]{2}){5}")


class Esp32FtmOptions(Params, frozen=True):
    """Selects whether the console's own words name the emitter."""

    emitter_from_log: bool = True
    """True: the emitter is the address in the session's lines before a result, which has none.
    False: all results are the configured emitter's."""


class Esp32FtmDecoder(FieldDecoder):
    """Decoder of the console of ESP-IDF's and Arduino's FTM examples, boot text too."""

    Options = Esp32FtmOptions
    options: Esp32FtmOptions
    has_stamps = True
    _IDF = re.compile(
        r"(?:I \(([0-9]{1,10})\) )?[\w.-]{1,40}: (?:[A-Za-z ]{1,40}\. )?"
        r"Estimated RTT - [0-9]{1,10} nSec, "
        r"Estimated Distance - ([0-9]{1,9}\.[0-9]{2}) meters"
    )
    _ARDUINO = re.compile(
        r"FTM Estimate: (?:Distance RAW: [0-9.]{1,12}, ?)?"
        r"Distance: (-?[0-9]{1,9}\.[0-9]+) m, Return Time: "
    )
    _SESSION = re.compile(rf"Starting FTM session with ({MAC.pattern})")
    _PEER = re.compile(rf"Peer\(({MAC.pattern})\) failed! \(Status - ([0-9])\)")
    _ENDS = re.compile(
        r"session ends with ([0-9]{1,3}) valid readings out of ([0-9]{1,3})"
        r"(?:,.{0,60}, Avg RSSI: (-[0-9]{1,3}))?"
    )
    NO_POWER = "-1"
    """Average power that the example prints of boards 5 m apart."""
    _FAILURES: Mapping[str, str] = {
        "FTM procedure timed out!": "timed out",
        "No valid FTM Measurements found!": "no valid measurements",
        "FTM Error: ": "the radio says that it failed",
        "Start time delay too high!": "start is too late",
    }
    _STATUS = ("success", "unsupported", "rejected", "no response", "failed", "no valid", "ended")

    def begin(self) -> None:
        """Begin without a session."""
        super().begin()
        self._forget()

    def _forget(self) -> None:
        self._peer: str | None = None
        self._quality: float | None = None
        self._power_dbm: float | None = None

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """Return the reading of a result; other lines describe the session of the next result."""
        if found := self._IDF.search(line):
            return self._result(found[2], None if found[1] is None else float(found[1]) / 1000.0)
        if found := self._ARDUINO.search(line):
            return self._result(found[1], None)
        if found := self._SESSION.search(line):
            self._forget()
            self._peer = found[1].lower()
        elif found := self._ENDS.search(line):
            self._quality = ratio(int(found[1]), int(found[2]))
            self._power_dbm = None if found[3] == self.NO_POWER else number(found[3])
        elif found := self._PEER.search(line):
            self._forget()
            self._peer = found[1].lower()
            status = int(found[2])
            word = self._STATUS[status] if status < len(self._STATUS) else "unknown"
            return self.refused(f"status {status} ({word})")
        else:
            for words, reason in self._FAILURES.items():
                if words in line:
                    return self.refused(reason)
            return self.passed_over(line)
        return []

    def _result(self, metres: str, time_s: float | None) -> list[RadioReading]:
        range_m, quality, power_dbm = number(metres), self._quality, self._power_dbm
        self._quality = self._power_dbm = None
        problem = problem_of_unsigned(range_m)
        if problem is not None:
            return self.refused(problem)
        peer = self._peer if self.options.emitter_from_log else None
        return self.understood(
            RadioReading(
                peer,
                device_time_s=time_s,
                range_m=range_m,
                quality=quality,
                power_dbm=power_dbm,
            )
        )


def problem_of_unsigned(range_m: float | None) -> str | None:
    """Return the reason to refuse a range, or None; negative ones print as 0 or near 2^32 cm."""
    if range_m is None or range_m > LONGEST_M:
        return "distance is out of bounds"
    return "distance 0: the radio cannot say less" if range_m == 0.0 else None


class IwFtmOptions(Params, frozen=True):
    """Selects how much of `iw`'s spread is used."""

    min_sigma_m: Annotated[float, msgspec.Meta(ge=0.0, le=100.0)] = 0.5
    """The variance is that within one burst, without the error that the position shares."""


class IwFtmDecoder(FieldDecoder):
    """Decoder of `iw dev ... measurement ftm_request`, run after run; unknown keys are skipped."""

    Options = IwFtmOptions
    options: IwFtmOptions
    _PEER = re.compile(
        rf"\s*Peer ({MAC.pattern}): status=([0-9]{{1,3}}) \(\w+\) @([0-9]{{1,19}}) tsf="
    )
    _FAILED = re.compile(r"\s*FTM failed: \w+ \(([0-9]{1,2})\)")
    _KEY = re.compile(r"\s*([A-Z_]{3,30}): (-?[0-9]{1,19})\s*")
    _STATUS = ("success", "refused", "timeout", "failure")
    _REASONS = (
        "unspecified",
        "no response",
        "rejected",
        "wrong channel",
        "peer is not capable",
        "invalid timestamp",
        "peer is busy",
        "bad parameters",
    )

    def begin(self) -> None:
        """Begin without a peer."""
        super().begin()
        self._forget()

    def _forget(self) -> None:
        self._peer: tuple[str, float] | None = None
        self._keys: dict[str, int] = {}

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """Read a line; a peer's block ends where the next begins, or at the end of the run."""
        if found := self._PEER.match(line):
            readings = self._finish()
            status = int(found[2])
            if status == 0:
                self._peer = (found[1].lower(), int(found[3]) * 1e-9)
            elif status != 3:
                self.refused(self._STATUS[status] if status < 4 else "unknown status")
            return readings
        if line.startswith("wdev "):
            return self._finish()
        if found := self._FAILED.match(line):
            reason = int(found[1])
            known = reason < len(self._REASONS)
            return self.refused(self._REASONS[reason] if known else "unknown reason")
        if self._peer is not None and (found := self._KEY.fullmatch(line)):
            if len(self._keys) < 64:
                self._keys[found[1]] = int(found[2])
            return []
        return self.passed_over(line) if line.strip() not in ("", "FTM") else []

    def _finish(self) -> list[RadioReading]:
        peer, keys = self._peer, self._keys
        self._forget()
        if peer is None:
            return []
        if "RTT_AVG" in keys:
            to_m, value, variance = 1e-12 * ONE_WAY_M_PER_S, keys["RTT_AVG"], "RTT_VARIANCE"
        elif "DIST_AVG" in keys:
            to_m, value, variance = 1e-3, keys["DIST_AVG"], "DIST_VARIANCE"
        else:
            return self.refused("no distance")
        range_m = value * to_m
        if abs(range_m) > LONGEST_M:
            return self.refused("distance is out of bounds")
        spread_m = math.sqrt(max(keys.get(variance, 0), 0)) * to_m
        sigma_m = max(spread_m, self.options.min_sigma_m) or None
        attempts, successes = keys.get("NUM_FTMR_ATTEMPTS"), keys.get("NUM_FTMR_SUCCESSES")
        return self.understood(
            RadioReading(
                emitter=peer[0],
                device_time_s=peer[1],
                range_m=range_m,
                range_sigma_m=sigma_m,
                quality=ratio(successes, attempts),
            )
        )
