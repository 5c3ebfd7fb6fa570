"""Finished blocks of runs, kept in one file: a run that was killed goes on where it was.

The key of a block names all that it follows from, sources included: whatever has changed since
gets another key, and blocks of other studies may lie in the same file.
"""

from __future__ import annotations

import hashlib
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from companion.errors import CompanionError, ConfigError

FILE_NAME = "blocks.sqlite3"
BUSY_S = 30.0
"""How long another run may hold the file."""
AT_ONCE = 500
"""Keys of one query; SQLite allows at least 999 of them."""


def key_of(*parts: object) -> str:
    """The key of what follows from values that msgspec can encode."""
    return hashlib.sha256(msgspec.json.encode(parts)).hexdigest()


class Store:
    """Results by key.

    Args:
        connection: To the file.
        path: For errors.
    """

    def __init__(self, connection: sqlite3.Connection, path: Path) -> None:
        self._connection = connection
        self._path = path

    def found(self, keys: Iterable[str]) -> dict[str, bytes]:
        """Those of the keys that have a result, with it.

        Raises:
            CompanionError: The file cannot be read.
        """
        wanted = list(keys)
        results: dict[str, bytes] = {}
        with self._explained():
            for start in range(0, len(wanted), AT_ONCE):
                part = wanted[start : start + AT_ONCE]
                marks = ",".join("?" * len(part))
                query = f"SELECT key, result FROM blocks WHERE key IN ({marks})"
                results.update(self._connection.execute(query, part))
        return results

    def keep(self, key: str, result: bytes) -> None:
        """Add a result; after this it survives the process.

        Raises:
            CompanionError: The file cannot be written.
        """
        with self._explained(), self._connection:
            self._connection.execute("INSERT OR REPLACE INTO blocks VALUES (?, ?)", (key, result))

    @contextmanager
    def _explained(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            raise CompanionError(
                f"{self._path}: {error}; free some space or delete the file, then run again"
            ) from error


@contextmanager
def opened(path: Path) -> Iterator[Store]:
    """The store in a file, made if it does not exist.

    Raises:
        ConfigError: It is no such file, or cannot be opened.
    """
    connection = None
    try:
        connection = sqlite3.connect(path, timeout=BUSY_S)
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("PRAGMA synchronous=NORMAL")  # a power cut may cost the last blocks
        connection.execute(
            "CREATE TABLE IF NOT EXISTS blocks (key TEXT PRIMARY KEY, result BLOB NOT NULL)"
        )
    except sqlite3.Error as error:
        if connection is not None:
            connection.close()
        raise ConfigError(f"{path}: {error}; delete it, or choose another --out") from None
    try:
        yield Store(connection, path)
    finally:
        connection.close()
