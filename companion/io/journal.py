"""The flight's black box: `.tlog`, `events.jsonl`, `result.json` and what the operator reads."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Mapping
from pathlib import Path

from companion.errors import CompanionError
from companion.guidance.commands import ReportResult, Severity
from companion.io.events import EventLog
from companion.io.files import write_json_atomic
from companion.io.tlog import TlogWriter

log = logging.getLogger("companion.flight")

LEVELS = {
    Severity.ERROR: logging.ERROR,
    Severity.WARNING: logging.WARNING,
    Severity.NOTICE: logging.INFO,
    Severity.INFO: logging.INFO,
}


class FlightJournal:
    """Writes everything the endpoint reports into one flight directory.

    Args:
        directory: Exists already.
        started_unix_s: Wall clock at `now_s` = 0; wall time is used for logs and nothing else.

    Raises:
        CompanionError: A file cannot be opened.
    """

    def __init__(self, directory: Path, started_unix_s: float) -> None:
        self.directory = directory
        self._started_unix_s = started_unix_s
        self._tlog = TlogWriter(directory / "flight.tlog")
        self._events = EventLog(directory / "events.jsonl")

    def frame(self, data: bytes, now_s: float) -> None:
        """Keep a raw frame."""
        self._tlog.write(data, self._started_unix_s + now_s)

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Keep an event."""
        self._events.write({"t_s": round(now_s, 4), "kind": kind, **fields})

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        """Keep a text and show it."""
        self.record("text", {"severity": severity.name.lower(), "text": text}, now_s)
        log.log(LEVELS[severity], "%7.1f s  %s", now_s, text)

    def result(self, report: ReportResult, now_s: float) -> None:
        """Write `result.json`; a disk that refuses it does not stop the flight."""
        estimate = report.estimate
        value = {
            "state": estimate.state.value,
            "latitude_deg": report.latitude_deg,
            "longitude_deg": report.longitude_deg,
            "r95_m": estimate.r95_m,
            "east_m": estimate.position_enu_m[0],
            "north_m": estimate.position_enu_m[1],
            "covariance_m2": estimate.covariance_m2,
            "range_offset_m": estimate.range_offset_m,
            "bearing_offset_rad": estimate.bearing_offset_rad,
            "measurements": estimate.measurements,
            "time_s": now_s,
            "unix_s": self._started_unix_s + now_s,
        }
        self.record("result", value, now_s)
        try:
            write_json_atomic(self.directory / "result.json", value)
        except CompanionError as error:
            log.error("%7.1f s  %s", now_s, error)

    def discard(self) -> None:
        """Close and remove the directory, because the flight never began."""
        self.close()
        shutil.rmtree(self.directory, ignore_errors=True)

    def close(self) -> None:
        """Write what is queued and close; what a slow or full disk cost is said."""
        self._tlog.close()
        self._events.close()
        dropped = self._tlog.dropped + self._events.dropped
        if dropped:
            log.warning(
                "%s: %d log entries were lost to a slow or full disk", self.directory, dropped
            )
