"""Ultra-wideband modules that range when they are asked: REYAX RYUW122, Ai-Thinker BU03, Pozyx.

Each request is answered by a measurement that has not been fetched, or by what the module prints
where the other one does not answer.

Sources: REYAX, RYUW122 AT command guide; Ai-Thinker, BU03 AT commands; pozyxLabs,
Pozyx-Python-library `pozyx_serial.py` and `structures/device.py`.
"""

from __future__ import annotations

import struct
from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sim_link.emulators.emulator import U32, Emulator, Round, clamped, lines


@dataclass(frozen=True, slots=True)
class Fresh:
    """A measurement that has not been fetched."""

    range_m: float
    clock_ms: int
    rssi_dbm: int


class AskedModule(Emulator):
    """Base of modules that answer line by line."""

    most = 1
    line_end: ClassVar[bytes] = b"\n"
    """Line end of a request."""

    def __init__(self, clock_s: float, rng: np.random.Generator) -> None:
        super().__init__(clock_s, rng)
        self._fresh: dict[str, Fresh] = {}
        """Readings by name on the wire."""
        self._begun = b""

    @abstractmethod
    def answer(self, command: str) -> list[str]:
        """Return the lines that answer a request."""

    @classmethod
    @abstractmethod
    def asks(cls, name: str) -> bytes:
        """Return the request for a range to the emitter of a name."""

    def encode(self, asked: Round) -> bytes:
        """Keep the round for the next request; return nothing."""
        self._fresh = {
            self.name_on_wire(each.emitter_id): Fresh(
                each.range_m, self.device_ms(asked.sent_at_s), round(each.power_dbm)
            )
            for each in asked.heard
            if each.range_m is not None
        }
        return b""

    def hear(self, data: bytes) -> bytes:
        """Answer each whole request."""
        *requests, self._begun = (self._begun + data).split(self.line_end)
        commands = [request.decode("ascii", "replace").strip() for request in requests]
        return lines([line for command in commands for line in self.answer(command)])

    def say(self, asked: Round) -> bytes:
        """Return the answers if each emitter of a round is asked for once."""
        printed = self.encode(asked)
        names = [self.name_on_wire(each.emitter_id) for each in asked.answers]
        return printed + b"".join(self.hear(self.asks(name)) for name in names)


class Ryuw122(AskedModule):
    """An anchor, which sends a tag four bytes; whole centimetres."""

    name = "ryuw122"
    title = "REYAX RYUW122"
    names = "TAG{0:05d}"
    request = b"AT+ANCHOR_SEND="
    VERSION = "+VER=RYUW122_V1.0.21"

    def answer(self, command: str) -> list[str]:
        """Return `+OK` at once; what the tag sent back, and the distance, once it has answered."""
        if command == "AT+VER?":
            return [self.VERSION, "+OK"]
        if not command.startswith("AT+ANCHOR_SEND="):
            return ["+OK"] if command == "AT" else ["+ERR=4"]
        tag = command.partition("=")[2].partition(",")[0]
        fresh = self._fresh.pop(tag, None)
        if fresh is None:
            return ["+OK"]
        return ["+OK", f"+ANCHOR_RCV={tag},5,HELLO,{round(100.0 * fresh.range_m)} cm"]

    @classmethod
    def asks(cls, name: str) -> bytes:
        """Return the request that sends four bytes to the named tag, which measures the range."""
        return f"AT+ANCHOR_SEND={name},4,PING\r\n".encode()


class Bu03(AskedModule):
    """Metres with six digits; exactly 0 where there is nothing."""

    name = "bu03"
    title = "Ai-Thinker BU03, AT+DISTANCE"
    names = ""
    request = b"AT+DISTANCE\r\n"

    def answer(self, command: str) -> list[str]:
        """Return the distance and OK."""
        if command != "AT+DISTANCE":
            return ["OK" if command == "AT" else "ERR"]
        fresh = self._fresh.pop("", None)
        return [f"distance: {0.0 if fresh is None else fresh.range_m:.6f}", "OK"]

    @classmethod
    def asks(cls, name: str) -> bytes:  # noqa: ARG003  it has one partner
        """Return the same for every emitter."""
        return cls.request


class Pozyx(AskedModule):
    """The USB port of a Pozyx: functions by their register, data in hexadecimal."""

    name = "pozyx"
    title = "Pozyx, USB"
    names = "0x{0:04x}"
    request = b"F,c7,"
    line_end = b"\r"
    WHO_AM_I, DONE, FAILED = "D,43", "D,01", "D,00"

    def __init__(self, clock_s: float, rng: np.random.Generator) -> None:
        super().__init__(clock_s, rng)
        self._last = bytes(10)

    def answer(self, command: str) -> list[str]:
        """Return the answer to DO_RANGING (started) or GETRANGEINFO (the last result)."""
        if command == "R,0,1":
            return [self.WHO_AM_I]
        parts = command.split(",")
        if len(parts) != 4 or parts[0] != "F":
            return []
        name = f"0x{parts[2][2:]}{parts[2][:2]}"
        if parts[1] == "c7":
            return [self.DONE + self._last.hex()]
        fresh = self._fresh.pop(name, None)
        if parts[1] != "b5" or fresh is None:
            return [self.FAILED]
        range_mm = clamped(1e3 * fresh.range_m, 0, U32 - 1)
        self._last = struct.pack("<IIh", fresh.clock_ms % U32, range_mm, fresh.rssi_dbm)
        return [self.DONE]

    @classmethod
    def asks(cls, name: str) -> bytes:
        """Return the requests to range, and to read the range."""
        swapped = name[4:] + name[2:4]
        return f"F,b5,{swapped},1\rF,c7,{swapped},11\r".encode()
