"""What a replay needs of an MCAP file; see `companion.io.mcap_log`."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field
from pathlib import Path

from companion.errors import ConfigError
from companion.io.mcap_schemas import FRAME_CHANNEL, INPUT_CHANNEL


@dataclass(slots=True)
class McapFlight:
    """A flight in one file."""

    path: Path
    flight_json: bytes
    inputs: bytes = b""
    frames: list[bytes] = field(default_factory=list)
    events: list[dict[str, object]] = field(default_factory=list)


def read_mcap_flight(path: Path) -> McapFlight:
    """The flight in an MCAP file.

    Raises:
        ConfigError: It cannot be read, or is none of ours.
    """
    try:
        from mcap.exceptions import McapError
        from mcap.reader import make_reader
    except ImportError as error:
        raise ConfigError(f"{path}: needs pip install 'companion-guidance[mcap]'") from error
    inputs: list[bytes] = []
    try:
        with path.open("rb") as file:
            reader = make_reader(file)
            kept = [m for m in reader.iter_metadata() if m.name == "flight"]
            if not kept:
                raise ConfigError(f"{path}: is no flight of the companion's")
            flight = McapFlight(path, kept[0].metadata["flight.json"].encode())
            for _, channel, message in reader.iter_messages(log_time_order=False):
                if channel.topic == FRAME_CHANNEL:
                    flight.frames.append(message.data)
                elif channel.topic == INPUT_CHANNEL:
                    inputs.append(message.data)
                elif channel.topic == "/events":
                    flight.events.append(json.loads(message.data))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error
    except (McapError, struct.error, EOFError, KeyError, ValueError) as error:
        raise ConfigError(f"{path}: not a whole MCAP file ({error}); try `mcap recover`") from error
    flight.inputs = b"".join(inputs)
    return flight
