"""Range offsets of single radios, kept by serial number between flights.

A USB radio is recognised by its name in `/dev/serial/by-id` on Linux, which has its maker and
serial number; any other one by its address.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import msgspec

from companion.errors import ConfigError
from companion.io.files import write_json_atomic

FILE = "radio-offsets.json"
BY_ID = Path("/dev/serial/by-id")


class KeptOffset(msgspec.Struct, frozen=True, kw_only=True):
    """Range offset that a calibration beside the antenna found."""

    range_offset_m: float
    scatter_m: float
    ranges: int
    unix_s: float


def radio_key(name: str, url: str, by_id: Path = BY_ID) -> str:
    """Return name and serial number of a radio; without a serial number, name and address."""
    device = url.removeprefix("serial:").partition(":")[0]
    try:
        links = sorted(by_id.iterdir())
    except OSError:
        links = []
    if device.startswith("/"):
        real = os.path.realpath(device)
        for link in links:
            if os.path.realpath(link) == real:
                return f"{name} {link.name}"
    return f"{name} {url}"


def kept_offsets(directory: Path) -> dict[str, KeptOffset]:
    """Return all kept offsets; a `ConfigError` names a file that cannot be read."""
    path = directory / FILE
    try:
        return msgspec.json.decode(path.read_bytes(), type=dict[str, KeptOffset])
    except FileNotFoundError:
        return {}
    except (OSError, msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: {error}; delete it and calibrate again") from None


def keep_offset(directory: Path, key: str, offset: KeptOffset) -> Path:
    """Add an offset, or replace that of the same radio; return the file."""
    offsets: Mapping[str, KeptOffset] = {**kept_offsets(directory), key: offset}
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / FILE
    write_json_atomic(path, {name: msgspec.structs.asdict(each) for name, each in offsets.items()})
    return path
