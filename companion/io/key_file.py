"""The signing key on disk."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from companion.errors import ConfigError
from companion.io.files import write_text_atomic
from companion.mav.signing import KEY_LENGTH, SigningKey

HOW_TO_MAKE_ONE = (
    "(umask 077; python3 -c 'import secrets; print(secrets.token_hex(32))' > signing.key)"
)
MAX_FILE_BYTES = 4096


def load_signing_key(path: Path) -> SigningKey:
    """The key in a file of 64 hexadecimal digits that only its owner may read.

    Raises:
        ConfigError: The file is missing, open to others (mode beyond 0600), or holds no key; the
            message never quotes the content.
    """
    try:
        with path.open("rb") as file:
            mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
            content = file.read(MAX_FILE_BYTES)
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
    """Store a key as a whole, for its owner's eyes only.

    Raises:
        CompanionError: It cannot be written.
    """
    write_text_atomic(path, f"{key.secret.hex()}\n", mode=0o600)
