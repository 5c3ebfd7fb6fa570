"""The flight's black box: frames, events, inputs, `result.json`, operator texts, and its folder."""

from __future__ import annotations

import fcntl
import json
import logging
import os
import re
import shutil
import threading
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

from companion.errors import CompanionError
from companion.guidance.commands import ReportResult, Severity
from companion.guidance.messages import radius_fields
from companion.handoff import HandoffFiles
from companion.io.files import (
    CLOSE_TIMEOUT_S,
    EVENTS,
    INPUTS,
    RESULT,
    TLOG,
    BackgroundReplacer,
    WriterHealth,
    plain,
)
from companion.io.links.link import NOTICE
from companion.io.log_files import EventLog, InputLog, TlogWriter
from companion.io.mcap_file import McapLog
from companion.link.interface import InputRecorder

log = logging.getLogger("companion.flight")
_FLIGHT_NAME = re.compile(r"(?P<time>\d{4}-\d\d-\d\dT\d\d-\d\d-\d\dZ)(-(?P<number>\d+))?")

LEVELS = {
    Severity.ERROR: logging.ERROR,
    Severity.WARNING: logging.WARNING,
    Severity.NOTICE: NOTICE,
}
EVENTS_SHARE = 0.1
INPUTS_SHARE = 0.45
"""Share of a flight's size limit for inputs; the tlog has an equal share."""


class BlackBox:
    """Journal that a process owns.

    This base class is used where no log can be written: it counts everything as lost and shows
    texts.
    """

    inputs: InputRecorder | None = None
    """Log of the endpoint's inputs; None here, so such a flight cannot be replayed."""

    def __init__(self) -> None:
        self._dropped = 0

    def frame(self, data: bytes, now_s: float) -> None:
        """Count a raw frame as lost."""
        del data, now_s
        self._dropped += 1

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Count an event as lost."""
        del kind, fields, now_s
        self._dropped += 1

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        """Show a text."""
        _show(severity, text, now_s)

    def result(self, report: ReportResult, now_s: float) -> None:
        """Show the result without storing it."""
        _show(Severity.NOTICE, f"result: {plain(report)}", now_s)

    @property
    def health(self) -> WriterHealth:
        """Return the state of the writers without waiting for them."""
        return WriterHealth(0, self._dropped, 0, 0.0, is_alive=True)

    @property
    def is_whole(self) -> bool:
        """True if nothing of the flight was lost so far."""
        return self.health.dropped == 0

    def discard(self) -> None:
        """Close and remove the log, because the flight never began."""

    def close(self, timeout_s: float = CLOSE_TIMEOUT_S) -> None:
        """Write everything queued within `timeout_s`, and close; losses are reported."""


class FlightJournal(BlackBox):
    """Writes everything the endpoint reports into one flight directory, and never waits for it.

    Wall clock time (`started_unix_s` at `now_s` = 0) is used for logs and nothing else. Beyond
    `max_bytes` the newest is kept. `mcap` receives everything as well, and is closed with it.
    """

    def __init__(
        self,
        directory: Path,
        started_unix_s: float,
        max_bytes: int | None = None,
        mcap: McapLog | None = None,
    ) -> None:
        self.directory = directory
        self.started_unix_s = started_unix_s
        self._began_s = time.monotonic()
        self._holding = _held(directory)
        events_bytes = None if max_bytes is None else int(EVENTS_SHARE * max_bytes)
        inputs_bytes = None if max_bytes is None else int(INPUTS_SHARE * max_bytes)
        kept = (events_bytes or 0) + (inputs_bytes or 0)
        tlog_bytes = None if max_bytes is None else max_bytes - kept
        self._tlog = TlogWriter(directory / TLOG, tlog_bytes)
        self._events = EventLog(directory / EVENTS, events_bytes)
        self._mcap = mcap
        also = None if mcap is None else mcap.input
        self.inputs: InputLog = InputLog(directory / INPUTS, inputs_bytes, also)
        self._results = BackgroundReplacer("write result.json")
        self._handoff = HandoffFiles()
        self._lock = threading.Lock()
        self._reports: dict[int | None, Mapping[str, object]] = {}
        """Latest report of each emitter, the newest last."""
        self._searched: Mapping[str, object] | None = None

    def frame(self, data: bytes, now_s: float) -> None:
        """Record a raw frame."""
        self._tlog.write(data, self.started_unix_s + now_s)
        if self._mcap is not None:
            self._mcap.frame(data, now_s)

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Record an event."""
        self._events.write({"t_s": round(now_s, 4), "kind": kind, **fields})
        if self._mcap is not None:
            self._mcap.record(kind, fields, now_s)

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        """Record a text and show it."""
        self.record("text", {"severity": severity.name.lower(), "text": text}, now_s)
        if self._mcap is not None:
            self._mcap.text(severity, text, now_s)
        _show(severity, text, now_s)

    def result(self, report: ReportResult, now_s: float) -> None:
        """Write `result.json`; a disk that refuses it does not stop the flight."""
        estimate = report.estimate
        value = {
            "emitter_id": report.emitter_id,
            "state": estimate.state.value,
            "latitude_deg": report.latitude_deg,
            "longitude_deg": report.longitude_deg,
            **radius_fields(estimate),
            "east_m": estimate.position_enu_m[0],
            "north_m": estimate.position_enu_m[1],
            "r95_budget_m": report.budget_m,
            "covariance_m2": estimate.covariance_m2,
            "range_offset_m": estimate.range_offset_m,
            "bearing_offset_rad": estimate.bearing_offset_rad,
            "measurements": estimate.measurements,
            "time_s": now_s,
            "unix_s": self.started_unix_s + now_s,
        }
        self.record("result", value, now_s)
        with self._lock:
            self._reports.pop(report.emitter_id, None)
            self._reports[report.emitter_id] = value
            self._write_result()
        for name, content in self._handoff.files(report, self.started_unix_s + now_s).items():
            self._results.replace(self.directory / name, content.encode())

    def result_of_search(self, searched: Mapping[str, object]) -> None:
        """Write `result.json` with the searched area; reports that were made stay. Any thread."""
        with self._lock:
            self._searched = searched
            self._write_result()

    def _write_result(self) -> None:
        """Write the newest report with all of them and the searched area, or that alone.

        Beside reports it has no track, which would take a control tick long to write.
        """
        reports, searched = list(self._reports.values()), dict(self._searched or {})
        value: dict[str, object] = searched
        if reports:
            searched.pop("track", None)
            value = {**reports[-1], "reports": reports, "searched": searched or None}
        text = json.dumps(plain(value), allow_nan=False, indent=2) + "\n"
        self._results.replace(self.directory / RESULT, text.encode())

    @property
    def health(self) -> WriterHealth:
        """Return the state of the writers without waiting for them."""
        writers = [writer.health for writer in (self._results, *self._logs)]
        return WriterHealth(
            queued=sum(one.queued for one in writers),
            dropped=sum(one.dropped for one in writers),
            bytes_kept=sum(one.bytes_kept for one in writers),
            silent_s=max(one.silent_s for one in writers),
            is_alive=all(one.is_alive for one in writers),
        )

    @property
    def _logs(self) -> tuple[TlogWriter, EventLog, InputLog]:
        return (self._tlog, self._events, self.inputs)

    def discard(self) -> None:
        """Close and remove the directory, because the flight never began."""
        self.close()
        shutil.rmtree(self.directory, ignore_errors=True)

    def close(self, timeout_s: float = CLOSE_TIMEOUT_S) -> None:
        """Write everything queued within `timeout_s`, and close; losses are reported."""
        deadline_s = time.monotonic() + timeout_s
        for log_file in self._logs:
            log_file.finish()
        for writer in (self._results, *self._logs):
            writer.close(max(0.0, deadline_s - time.monotonic()))
        if self._mcap is not None:
            self._mcap.close(max(0.0, deadline_s - time.monotonic()))
        if self._holding is not None:
            os.close(self._holding)
            self._holding = None
        if not self.is_whole:
            log.warning("%s: lost to a slow or full disk: %s", self.directory, self._losses())

    def _losses(self) -> str:
        """Return the names of the logs with gaps, and the times at which the gaps begin."""
        since = [(each, each.lost_since_s) for each in self._logs]
        words = [
            f"{each.dropped} entries of {each.path.name} after {at_s - self._began_s:.0f} s"
            for each, at_s in since
            if at_s is not None
        ]
        return ", ".join([*words, RESULT] if self._results.dropped else words)


def new_flight_directory(root: Path, unix_s: float) -> Path:
    """Return a new directory under `root`, named by the time.

    `2026-11-21T02-50-00Z`, then `...-2`.
    """
    name = datetime.fromtimestamp(unix_s, UTC).strftime("%Y-%m-%dT%H-%M-%SZ")
    suffix = 1
    while True:
        directory = root / (name if suffix == 1 else f"{name}-{suffix}")
        try:
            directory.mkdir(parents=True)
        except FileExistsError as error:
            if not directory.is_dir():
                text = f"{root}: not a directory; choose another log.directory"
                raise CompanionError(text) from error
            suffix += 1
        except OSError as error:
            raise CompanionError(
                f"{directory}: cannot be created ({error.strerror}); choose another log.directory"
            ) from error
        else:
            return directory


def delete_old_flights(root: Path, keep: int, present: Path) -> list[Path]:
    """Delete all but the newest `keep` flight directories below `root`; return the deleted ones.

    Only names as `new_flight_directory` makes them count, and what another companion flies now
    stays. `present` counts as the newest even if its name does not: a clock may have been set back.
    """
    named = [(m, p) for p in root.iterdir() if (m := _FLIGHT_NAME.fullmatch(p.name))]
    others = [(m["time"], int(m["number"] or 1), p) for m, p in named if p != present]
    oldest = sorted(others)[: max(0, len(others) + 1 - keep)]
    for *_, directory in oldest:
        if directory.is_dir() and not directory.is_symlink():
            holding = _held(directory, fcntl.LOCK_EX)
            if holding is not None:
                shutil.rmtree(directory, ignore_errors=True)
                os.close(holding)
    return [directory for *_, directory in oldest if not os.path.lexists(directory)]


def _held(directory: Path, kind: int = fcntl.LOCK_SH) -> int | None:
    """Return a descriptor that locks a flight's folder; None if another companion flies it now."""
    try:
        descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        return None
    except OSError:  # a file system without locks
        pass
    return descriptor


def _show(severity: Severity, text: str, now_s: float) -> None:
    log.log(LEVELS.get(severity, logging.INFO), "%7.1f s  %s", now_s, text)
