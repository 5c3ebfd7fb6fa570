"""Files written atomically as a whole, and flight directories with the names of their files."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
from datetime import UTC, datetime
from enum import Enum
from pathlib import Path

from companion.errors import CompanionError, ConfigError

OnDamage = Callable[[int], None]
"""Called with each damaged position of a log: a byte, a record or a line of it."""
_FLIGHT_NAME = re.compile(r"(?P<time>\d{4}-\d\d-\d\dT\d\d-\d\d-\d\dZ)(-(?P<number>\d+))?")


def plain(value: object) -> object:
    """Return `value` in JSON's own types: NaN and infinity become None, enums their value.

    Dataclasses become objects and arrays lists. Anything that JSON has no type for becomes its
    text, so that writing a log entry never fails.
    """
    if isinstance(value, Enum):
        return plain(value.value)
    if value is None or isinstance(value, bool | str | int):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if hasattr(value, "tolist"):  # numpy's scalars and arrays, without importing numpy
        return plain(value.tolist())
    return str(value)


_LINES = json.JSONEncoder(allow_nan=False, separators=(",", ":"), default=plain)


def json_line(value: object) -> bytes:
    """Return `plain(value)` as one line of ASCII JSON, without the newline."""
    try:
        text = _LINES.encode(value)  # most values are plain already, down to every number
    except (ValueError, TypeError):
        text = _LINES.encode(plain(value))
    return text.encode("ascii")


def read_file(path: Path) -> bytes:
    """Return the content of a file; raises a `ConfigError` if it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error


def write_json_atomic(path: Path, value: object) -> None:
    """Replace a JSON file as a whole; see `write_bytes_atomic`."""
    write_text_atomic(path, json.dumps(plain(value), allow_nan=False, indent=2) + "\n")


def write_text_atomic(path: Path, text: str, mode: int = 0o666) -> None:
    """Replace a text file as a whole; see `write_bytes_atomic`."""
    write_bytes_atomic(path, text.encode(), mode)


def write_bytes_atomic(path: Path, content: bytes, mode: int = 0o666) -> None:
    """Replace a file as a whole: after a power cut there is either the old or the new content.

    `mode` is its permission bits before the umask. Raises a `CompanionError` if it cannot be
    written; an old file is still there then.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")

    def opener(name: str, flags: int) -> int:
        return os.open(name, flags, mode)

    try:
        temporary.unlink(missing_ok=True)
        with open(temporary, "wb", opener=opener) as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
        _sync_directory(path.parent)
    except OSError as error:
        with suppress(OSError):  # on a disk that went read-only the temporary file stays
            temporary.unlink(missing_ok=True)
        raise CompanionError(
            f"{path}: cannot be written ({error.strerror}); check the disk and its permissions"
        ) from error


def check_writable(path: Path) -> None:
    """Check before long work that its output can be written; raises a `CompanionError` if not."""
    if path.is_dir() or not path.name:
        raise CompanionError(f"{path}: is a folder; give the name of a file")
    if not path.parent.is_dir():
        raise CompanionError(f"{path}: there is no folder {path.parent}")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise CompanionError(f"{path}: cannot be written; check its permissions")


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
                raise CompanionError(f"{root}: not a directory; choose another place") from error
            suffix += 1
        except OSError as error:
            raise CompanionError(
                f"{directory}: cannot be made ({error.strerror}); choose another place"
            ) from error
        else:
            return directory


def delete_old_flights(root: Path, keep: int, present: Path) -> list[Path]:
    """Delete all but the newest `keep` flight directories below `root`; return the deleted ones.

    Only names as `new_flight_directory` makes them count. `present` counts as the newest even if
    its name does not: a clock may have been set back.
    """
    named = [(m, p) for p in root.iterdir() if (m := _FLIGHT_NAME.fullmatch(p.name))]
    others = [(m["time"], int(m["number"] or 1), p) for m, p in named if p != present]
    oldest = sorted(others)[: max(0, len(others) + 1 - keep)]
    for *_, directory in oldest:
        if directory.is_dir() and not directory.is_symlink():
            shutil.rmtree(directory, ignore_errors=True)
    return [directory for *_, directory in oldest if not os.path.lexists(directory)]


def _sync_directory(directory: Path) -> None:
    """Make a rename survive a power cut."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


TLOG, MCAP, EVENTS, INPUTS = "flight.tlog", "flight.mcap", "events.jsonl", "flight.inputs"
FLIGHT, RESULT, REPORT = "flight.json", "result.json", "report.html"
