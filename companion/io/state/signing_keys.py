"""The signing key on disk, and the timestamps that signing must keep from run to run.

Theory of operation. Without its own timestamp and the last one of every stream a frame recorded
before a restart would be accepted after it. They are kept beside the key, in two slots written
alternately with a checksum, so that a power cut loses one at most. After a crash the last seconds
are missing: then every stream must first be newer than the stored timestamp by `CRASH_MARGIN_S`.

The timestamps belong to their key: with another key they start from zero, and so a new key is also
the remedy when a clock was once far ahead.
"""

from __future__ import annotations

import hashlib
import os
import stat
import zlib
from pathlib import Path

import msgspec

from companion.errors import ConfigError
from companion.io.background_output import BackgroundReplacer
from companion.io.files import write_bytes_atomic, write_text_atomic
from companion.mav.signing import (
    AS_THE_GUIDE,
    KEY_LENGTH,
    TICKS_PER_S,
    Signing,
    SigningKey,
    SigningPolicy,
)

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
        with path.open("rb") as file:
            mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
            content = file.read(MAX_KEY_FILE_BYTES)
    except OSError as error:
        raise ConfigError(
            f"{path}: the signing key cannot be read ({error.strerror}); make one with "
            f"{HOW_TO_MAKE_ONE}"
        ) from None
    if mode & 0o177:
        raise ConfigError(
            f"{path}: the signing key is open to others (mode {mode:04o}); chmod 600 {path}"
        )
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
    """Nothing was heard or signed after it."""
    timestamp: int
    streams: list[tuple[tuple[int, ...], int]]
    clock: int | None = None
    """Our own, which no peer moved."""


class SigningStore:
    """The two slots `NAME.time-0` and `-1` beside a key; a `ConfigError` if none can be read."""

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
                f"{self.paths[0]} and {self.paths[1].name}: what signing remembers cannot be read; "
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
    """Return a keeper that restores signing from the memory beside the key and stores it again."""
    store = SigningStore(key_file, key)
    return SigningKeeper(store.signing(key, rules), store)


def _read(path: Path) -> bytes | None:
    try:
        with path.open("rb") as file:
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
