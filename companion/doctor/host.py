"""Looks at this computer."""

from __future__ import annotations

import importlib.metadata
import os
import sys
import time
from contextlib import suppress
from pathlib import Path

from companion.doctor.facts import HostFacts, PlaceFacts
from companion.errors import CompanionError
from companion.io.files import write_bytes_atomic
from companion.io.key_file import load_signing_key

MEGABYTE = 1_000_000
_SYNCHRONISED = Path("/run/systemd/timesync/synchronized")
_SYNCHRONISERS = (Path("/run/systemd/timesync"), Path("/run/chrony"), Path("/run/ntpd.pid"))


def look_at_host(logs: Path, state: Path, key_file: str | None) -> HostFacts:
    """What there is.

    Args:
        logs: Where flights are kept.
        state: Where checkpoints and locks are kept.
        key_file: Of the signing key; None: there is none.
    """
    return HostFacts(
        python=(sys.version_info.major, sys.version_info.minor, sys.version_info.micro),
        numpy=_version("numpy") or "?",
        numba=_version("numba"),
        logs=look_at_place(logs),
        state=look_at_place(state),
        key_problem=None if key_file is None else _key_problem(Path(key_file)),
        has_key=key_file is not None,
        unix_s=time.time(),
        is_clock_synchronised=_is_clock_synchronised(),
    )


def look_at_place(directory: Path) -> PlaceFacts:
    """Whether and how fast a directory can be written; one that is missing is made and left."""
    probe = directory / f".doctor.{os.getpid()}"
    try:
        directory.mkdir(parents=True, exist_ok=True)
        began_s = time.monotonic()
        write_bytes_atomic(probe, bytes(MEGABYTE))
        took_s = time.monotonic() - began_s
        room = os.statvfs(directory)
    except OSError as error:
        return PlaceFacts(str(directory), error.strerror or str(error))
    except CompanionError as error:
        return PlaceFacts(str(directory), str(error.__cause__ or error))
    finally:
        with suppress(OSError):
            probe.unlink(missing_ok=True)
    free_mb = room.f_bavail * room.f_frsize / 1e6
    return PlaceFacts(str(directory), None, round(free_mb, 1), round(took_s, 4))


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _key_problem(path: Path) -> str | None:
    try:
        load_signing_key(path)
    except CompanionError as error:
        return str(error)
    return None


def _is_clock_synchronised() -> bool | None:
    """As far as the file system tells."""
    if _SYNCHRONISED.exists():
        return True
    return None if not any(path.exists() for path in _SYNCHRONISERS) else False
