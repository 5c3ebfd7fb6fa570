"""Files that `companion setup` writes and removes: all of them, or none.

Every file is made and checked in a folder of its own, and then moved into its place. An earlier
file there is kept beside it, under its name and `.before-setup`, and comes back with `--remove`.
`setup.json` lists the written files, with checksums, so that no file is deleted that was changed
since.
"""

from __future__ import annotations

import hashlib
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec

from companion.config.schema import CompanionConfig, load_config
from companion.errors import CompanionError, ConfigError
from companion.io.files import read_file, write_bytes_atomic

CONFIG, SERVICE_OPTIONS, UNIT = "companion.yaml", "service.env", "companion.service"
RECORD = "setup.json"
BEFORE = ".before-setup"


class SetupRecord(msgspec.Struct, frozen=True):
    """Files of one setup: absolute paths to the SHA-256 of their contents."""

    files: dict[str, str]


def check_files(contents: Mapping[str, bytes]) -> CompanionConfig:
    """Load the configuration as a flight would; `contents` by names in its folder."""
    with tempfile.TemporaryDirectory() as temporary:
        for name, content in contents.items():
            (Path(temporary) / name).write_bytes(content)
        try:
            return load_config(Path(temporary) / CONFIG)
        except ConfigError as error:
            raise ConfigError(str(error).replace(f"{temporary}/", "")) from None


def write_files(directory: Path, contents: Mapping[Path, bytes]) -> None:
    """Write the files, and the record; if one cannot be written, everything is as before."""
    record = _record(directory)
    files = {} if record is None else dict(record.files)
    earlier: dict[Path, bytes | None] = {}
    kept: list[Path] = []
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for path, content in contents.items():
            earlier[path] = read_file(path) if path.exists() else None
            kept += _keep_what_was_there(path, files)
            write_bytes_atomic(path, content)
            files[str(path.absolute())] = _sum(content)
        text = msgspec.json.format(msgspec.json.encode(SetupRecord(files)), indent=2)
        write_bytes_atomic(directory / RECORD, text + b"\n")
    except (CompanionError, OSError) as error:
        _undo(earlier, kept)
        if isinstance(error, CompanionError):
            raise
        raise CompanionError(f"{directory}: cannot be made ({error.strerror})") from error


def _undo(earlier: Mapping[Path, bytes | None], kept: Sequence[Path]) -> None:
    """Restore the files that a failed setup had replaced."""
    for path, content in earlier.items():
        if content is None:
            path.unlink(missing_ok=True)
        elif read_file(path) != content:
            write_bytes_atomic(path, content)
    for path in kept:
        path.unlink(missing_ok=True)


def remove_files(directory: Path) -> list[str]:
    """Undo a setup; return a line for each file. Raise `ConfigError` if there was none."""
    record = _record(directory)
    if record is None:
        raise ConfigError(f"{directory}: no setup was made here ({RECORD} is missing)")
    lines = []
    for name, checksum in record.files.items():
        path = Path(name)
        if path.exists() and _sum(read_file(path)) != checksum:
            lines.append(f"kept: {path}, which was changed since; delete it yourself")
            continue
        is_back = _put_back(path)
        lines.append(f"{'as before the setup' if is_back else 'removed'}: {path}")
    (directory / RECORD).unlink()
    return lines


def _record(directory: Path) -> SetupRecord | None:
    path = directory / RECORD
    if not path.exists():
        return None
    try:
        return msgspec.json.decode(read_file(path), type=SetupRecord)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: is not what a setup wrote ({error})") from None


def _keep_what_was_there(path: Path, files: Mapping[str, str]) -> list[Path]:
    """Keep a file that no setup wrote, or that was changed since, beside; return its copies."""
    if not path.exists() or files.get(str(path.absolute())) == _sum(read_file(path)):
        return []
    before = path.with_name(path.name + BEFORE)
    shutil.copy2(path, before)
    return [before]


def _put_back(path: Path) -> bool:
    """Delete a file, or restore the earlier one; return True if there was one."""
    before = path.with_name(path.name + BEFORE)
    if before.exists():
        before.replace(path)
        return True
    path.unlink(missing_ok=True)
    return False


def _sum(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
