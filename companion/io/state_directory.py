"""The state directory: locks that allow one companion per vehicle, signing key and its timestamps.

Locks. `flock` on a file of the state directory: the kernel releases it however the process ends, so
a stale lock cannot exist, and the file itself may stay. A companion bound to one system id shares
the link's lock with those bound to others (several vehicles behind one router) and holds its id's
lock alone; one that binds to the first vehicle it hears holds the link's lock alone.

The lock is named after the resolved address, however it is spelled. In a directory that all users
share anyone could take it; so companions of two users, state directories or computers are
recognised only by their frames, see `companion.link.outlet.OwnFrames`.

Timestamps of signing. Without its own timestamp and the last one of every stream a frame recorded
before a restart would be accepted after it. They are kept next to the key, in two slots written
alternately with a checksum, so that a power cut loses one at most. After a crash the last seconds
are missing: then every stream must first be newer than the stored timestamp by `CRASH_MARGIN_S`.

The timestamps belong to their key: with another key they start from zero, and so a new key is also
the remedy when a clock was once far ahead.
"""

from __future__ import annotations

import fcntl
import hashlib
import logging
import os
import re
import shlex
import socket
import stat
import threading
import zlib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import msgspec

from companion.errors import ConfigError, LinkError
from companion.io.files import BackgroundReplacer, open_file, write_bytes_atomic, write_text_atomic
from companion.io.links.transports import OwnLine, Pty, SerialPort, Transport
from companion.mav.signing import (
    AS_THE_GUIDE,
    KEY_LENGTH,
    TICKS_PER_S,
    Signing,
    SigningKey,
    SigningPolicy,
)


def state_directory(configured: str | None, environment: Mapping[str, str]) -> Path:
    """Return the state directory, which need not exist: as configured, systemd's, or XDG's.

    Raises a `ConfigError` if none of these is known: a directory that others may write to is
    unsafe.
    """
    if configured is not None:
        return Path(configured)
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

    `link` is the vehicle link's address in its canonical spelling, and `resolved` the one that it
    leads to, see `resolved_address`; without a system id it is for the first vehicle that is heard.
    Raises a `LinkError` if another companion has the vehicle.
    """

    def __init__(
        self, directory: Path, link: str, system_id: int | None, resolved: str | None = None
    ) -> None:
        self._descriptors: list[int] = []
        name = lock_name(resolved or link)
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


def resolved_address(link: Transport) -> str:
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

    thread = threading.Thread(target=look_up, name="address of a link", daemon=True)
    thread.start()
    thread.join(LOOK_UP_S)
    return found[-1]


def lock_name(link: str) -> str:
    """Return a file name for a link: readable, and different for different links."""
    readable = re.sub(r"[^A-Za-z0-9.]+", "-", link).strip("-")[:60]
    return f"{readable}-{hashlib.sha256(link.encode()).hexdigest()[:8]}"


HOW_TO_MAKE_ONE = (
    "(umask 077; python3 -c 'import secrets; print(secrets.token_hex(32))' > signing.key)"
)
MAX_KEY_FILE_BYTES = 4096


def load_signing_key(path: Path) -> SigningKey:
    """Return the key in a file of 64 hexadecimal digits that only its owner may read.

    Raises a `ConfigError`, which never quotes the content, if the file is missing, readable by
    others (mode beyond 0600), or holds no key.
    """
    try:
        with open_file(path) as file:
            mode = stat.S_IMODE(path.stat().st_mode)
            content = file.read(MAX_KEY_FILE_BYTES)
    except OSError as error:
        raise ConfigError(
            f"{path}: the signing key cannot be read ({error.strerror}); make one with "
            f"{HOW_TO_MAKE_ONE}"
        ) from None
    text = content.decode("ascii", errors="replace").strip()
    try:
        secret = bytes.fromhex(text)
    except ValueError:
        secret = b""
    if len(secret) != KEY_LENGTH:
        raise ConfigError(
            f"{path}: a signing key is {2 * KEY_LENGTH} hexadecimal digits; make one with "
            f"{HOW_TO_MAKE_ONE}"
        )
    if mode & 0o177:
        raise ConfigError(
            f"{path}: the signing key is open to others (mode {mode:04o}); "
            f"chmod 600 {shlex.quote(str(path))}"
        )
    try:
        return SigningKey(secret)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def store_signing_key(path: Path, key: SigningKey) -> None:
    """Write a key file that only its owner can read."""
    write_text_atomic(path, f"{key.secret.hex()}\n", mode=0o600)


VERSION = 1
SLOTS = 2
STORE_PERIOD_S = 1.0
CRASH_MARGIN_S = 2.0
"""Storing takes a while, too."""
MAX_FILE_BYTES = 64 * 1024
MODE = 0o600


class _Slot(msgspec.Struct, frozen=True):
    """Content of a slot, as JSON in front of its checksum."""

    version: int
    key: str
    """Name of the key, which does not reveal it."""
    generation: int
    """Rises with every storing."""
    is_end: bool
    """True if nothing was heard or signed after it."""
    timestamp: int
    streams: list[tuple[tuple[int, ...], int]]
    clock: int | None = None
    """Our own, which no peer moved."""


class SigningStore:
    """The two slots `NAME.time-0` and `-1` next to a key; a `ConfigError` if none can be read."""

    def __init__(self, key_file: Path, key: SigningKey) -> None:
        self.paths = tuple(key_file.with_name(f"{key_file.name}.time-{n}") for n in range(SLOTS))
        self._key_name = hashlib.sha256(b"name of the key" + key.secret).hexdigest()[:16]
        self._last = self._load()

    def signing(self, key: SigningKey, rules: SigningPolicy) -> Signing:
        """Return a `Signing` with the stored timestamps."""
        last = self._last
        if last is None:
            return Signing(key, rules=rules)
        margin = 0 if last.is_end else round(CRASH_MARGIN_S * TICKS_PER_S)
        streams = {name: timestamp + margin for name, timestamp in last.streams}
        return Signing(key, last.timestamp + margin, streams, rules, stored_clock=last.clock)

    def next_content(self, signing: Signing, *, is_end: bool) -> tuple[Path, bytes]:
        """Return the slot to replace now and its content; with `is_end` no frame follows."""
        generation = 1 if self._last is None else self._last.generation + 1
        self._last = _Slot(
            VERSION,
            self._key_name,
            generation,
            is_end,
            signing.timestamp,
            list(signing.streams.items()),
            signing.clock,
        )
        body = msgspec.json.encode(self._last)
        return self.paths[generation % SLOTS], body + f" {zlib.crc32(body):08x}\n".encode()

    def _load(self) -> _Slot | None:
        """Return the newest memory of this key, or None."""
        contents = [content for path in self.paths if (content := _read(path)) is not None]
        slots = [slot for content in contents if (slot := _decode_slot(content)) is not None]
        if contents and not slots:
            raise ConfigError(
                f"{self.paths[0]} and {self.paths[1].name}: the signing timestamps cannot be read; "
                "recorded frames might come back: make a new key, or delete both"
            )
        own = [slot for slot in slots if slot.key == self._key_name]
        return max(own, key=lambda slot: slot.generation, default=None)


class SigningKeeper:
    """Stores the state of signing: at once, then each second in the background, and at the end."""

    def __init__(self, signing: Signing, store: SigningStore) -> None:
        self.signing = signing
        self._store = store
        self._store_now(is_end=False)
        self._replacer = BackgroundReplacer("write signing time", MODE)
        self._next_s = STORE_PERIOD_S

    def keep(self, now_s: float) -> None:
        """Store the state if it is due; never waits."""
        if now_s >= self._next_s:
            self._next_s = now_s + STORE_PERIOD_S
            self._replacer.replace(*self._store.next_content(self.signing, is_end=False))

    def close(self) -> None:
        """Store the last state; the crash margin covers a disk that refuses it."""
        self._replacer.close()
        self._store_now(is_end=True)

    def _store_now(self, *, is_end: bool) -> None:
        path, content = self._store.next_content(self.signing, is_end=is_end)
        write_bytes_atomic(path, content, mode=MODE)


def open_signing_keeper(
    key_file: Path, key: SigningKey, rules: SigningPolicy = AS_THE_GUIDE
) -> SigningKeeper:
    """Return a keeper that restores signing from the memory next to the key and stores it again."""
    store = SigningStore(key_file, key)
    return SigningKeeper(store.signing(key, rules), store)


def _read(path: Path) -> bytes | None:
    try:
        with open_file(path) as file:
            return file.read(MAX_FILE_BYTES)
    except FileNotFoundError:
        return None
    except OSError:
        return b""


def _decode_slot(content: bytes) -> _Slot | None:
    body, _, checksum = content.rpartition(b" ")
    if checksum != f"{zlib.crc32(body):08x}\n".encode():
        return None
    try:
        slot = msgspec.json.decode(body, type=_Slot)
    except msgspec.DecodeError:
        return None
    return slot if slot.version == VERSION else None
