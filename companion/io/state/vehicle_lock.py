"""The state directory, and locks in it that allow one companion per vehicle.

`flock` on a file of the state directory: the kernel releases it however the process ends, so a
stale lock cannot exist, and the file itself may stay. A companion bound to one system id shares the
link's lock with those bound to others (several vehicles behind one router) and holds its id's lock
alone; one that binds to the first vehicle it hears holds the link's lock alone.

The lock is named after the resolved address, however it is spelled. In a directory that all users
share anyone could take it; so companions of two users, state directories or computers are
recognised only by their frames, see `companion.link.outlet.OwnFrames`.
"""

from __future__ import annotations

import fcntl
import hashlib
import logging
import os
import re
import socket
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from companion.errors import ConfigError, LinkError
from companion.io.links.transports import OwnLine, Pty, SerialPort, Transport


def state_directory(configured: str | None, environment: Mapping[str, str]) -> Path:
    """Return the state directory, which need not exist: as configured, systemd's, or XDG's.

    Raises a `ConfigError` if none of these is known: a directory that others may write to is
    unsafe.
    """
    if configured is not None:
        return Path(configured).expanduser()
    of_service = environment.get("STATE_DIRECTORY", "").partition(":")[0]
    if of_service.startswith("/"):
        return Path(of_service)
    base = environment.get("XDG_STATE_HOME", "")
    if base.startswith("/"):
        return Path(base) / "companion"
    home = environment.get("HOME", "")
    if not home.startswith("/"):
        raise ConfigError(
            "$.process.state_directory: there is no HOME to keep checkpoints and locks in; "
            "configure a folder that only this user may write to"
        )
    return Path(home) / ".local/state/companion"


LOOK_UP_S = 2.0
"""Longest wait for a name server."""
logger = logging.getLogger("companion.io")


class VehicleLock:
    """Lock of a vehicle, held from construction to `release`, or to the end of the process.

    `link` is the vehicle link's address in its canonical spelling, and `place` the resolved one,
    see `place_of`; without a system id it is for the first vehicle that is heard. Raises a
    `LinkError` if another companion has the vehicle.
    """

    def __init__(
        self, directory: Path, link: str, system_id: int | None, place: str | None = None
    ) -> None:
        self._descriptors: list[int] = []
        name = lock_name(place or link)
        try:
            directory.mkdir(parents=True, exist_ok=True)
            is_shared = system_id is not None
            self._take(directory / f"{name}.lock", link, is_shared=is_shared)
            if system_id is not None:
                self._take(directory / f"{name}.system-{system_id}.lock", link, is_shared=False)
        except LinkError:
            self.release()
            raise
        except OSError as error:  # a disk that went read-only is no reason not to fly
            logger.warning(
                "%s: no lock can be kept (%s); make sure that no other companion flies this "
                "vehicle",
                directory,
                error.strerror,
            )

    def release(self) -> None:
        """Release the lock; a second call does nothing."""
        for descriptor in self._descriptors:
            os.close(descriptor)
        self._descriptors.clear()

    def _take(self, path: Path, link: str, *, is_shared: bool) -> None:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
        self._descriptors.append(descriptor)
        kind = fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX
        try:
            fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
        except BlockingIOError:
            number = os.pread(descriptor, 32, 0).decode("ascii", errors="replace").strip()
            holder = f"process {number}" if number.isdigit() else "of another process"
            raise LinkError(
                f"{link}: another companion ({holder}) has this vehicle; stop it, or "
                "choose another link or vehicle.system_id"
            ) from None
        with suppress(OSError):  # only for the message to the next process
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)


def place_of(link: Transport) -> str:
    """Return the resolved address of a link, the same for every spelling; unknown names stay."""
    kind = type(link).__name__
    match link:
        case SerialPort():
            return f"{kind} {os.path.realpath(link.device)}"
        case Pty():
            folder, name = os.path.split(
                link.path
            )  # the name itself is a link that this program makes
            return f"{kind} {os.path.join(os.path.realpath(folder), name)}"
        case OwnLine():
            return str(link)
    return f"{kind} {_number_of(link.host)}:{link.port}"


def _number_of(host: str) -> str:
    """Return a host's address; a name server that is slow is not waited for."""
    found = [host]

    def look_up() -> None:
        with suppress(OSError, UnicodeError):
            found.append(socket.gethostbyname(host))

    thread = threading.Thread(target=look_up, name="place of a link", daemon=True)
    thread.start()
    thread.join(LOOK_UP_S)
    return found[-1]


def lock_name(link: str) -> str:
    """Return a file name for a link: readable, and different for different links."""
    readable = re.sub(r"[^A-Za-z0-9.]+", "-", link).strip("-")[:60]
    return f"{readable}-{hashlib.sha256(link.encode()).hexdigest()[:8]}"
