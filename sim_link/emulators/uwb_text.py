"""Ultra-wideband radios that print text, and modules that range when they are asked.

PANS shell, Qorvo CLI, PDoA kits and Makerfabs AT print by themselves. REYAX RYUW122, Ai-Thinker
BU03 and Pozyx answer each request by a measurement that has not been fetched, or by what the
module prints where the other one does not answer.

Sources: Decawave, DWM1001 firmware API guide (shell `lec`); Qorvo, QM33 SDK developer manual as
users quote it; Makerfabs, MaUWB_DW3000 AT manual 1.0.8; users' captures of `JS` frames; REYAX,
RYUW122 AT command guide; Ai-Thinker, BU03 AT commands; pozyxLabs, Pozyx-Python-library
`pozyx_serial.py` and `structures/device.py`.
"""

from __future__ import annotations

import json
import math
import struct
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from companion.domain import PositionEnu
from sim_link.emulators.emulator import LINE_END, U32, Answer, Emulator, Round, clamped, lines

PROMPT = "dwm> "
SLOTS = 8
SUPERFRAME_US = 100_000
"""Length of a kit's superframe, in which the time of a range lies."""


def dist_line(
    anchors: Sequence[tuple[str, PositionEnu, float]], position: tuple[float, float, float, int]
) -> str:
    """Format the line of `lec`: anchors with id, position and range; the tag's own position."""
    text = f"DIST,{len(anchors)}"
    for number, (name, (x, y, z), range_m) in enumerate(anchors):
        text += f",AN{number},{name},{x:.2f},{y:.2f},{z:.2f},{range_m:.2f}"
    x, y, z, quality = position
    return f"{text},POS,{x:.2f},{y:.2f},{z:.2f},{quality}"


class Pans(Emulator):
    """A DWM1001 tag whose shell prints `lec` lines; the command `lec` switches them off and on.

    Without an answering anchor no line is printed.
    """

    name = "pans"
    title = "Decawave DWM1001 PANS, shell"
    names = "{0:04X}"
    banner = (
        lines(["", "", " DWM1001 TWR Real Time Location System", "", " Help      :  ? or help", ""])
        + PROMPT.encode()
    )

    def __init__(self, clock_s: float, rng: np.random.Generator) -> None:
        super().__init__(clock_s, rng)
        self._is_on = True
        self._typed = b""

    def hear(self, data: bytes) -> bytes:
        """Return the shell's prompt for every carriage return."""
        *typed, self._typed = (self._typed + data.replace(b"\n", b"\r"))[-256:].split(b"\r")
        self._is_on ^= typed.count(b"lec") % 2 == 1
        return (LINE_END + PROMPT).encode() * len(typed)

    def encode(self, asked: Round) -> bytes:
        """Return a line if the shell prints any."""
        nowhere = (0.0, 0.0, 0.0)
        anchors = [
            (self.name_on_wire(answer.emitter_id), nowhere, answer.range_m)
            for answer in asked.heard
            if answer.range_m is not None
        ]
        if not anchors or not self._is_on:
            return b""
        return lines([dist_line(anchors, (*nowhere, 0))])


def qorvo_record(address: int, values: Mapping[str, str], status: str = "SUCCESS") -> str:
    """Return one peer of a SESSION_INFO_NTF in its brackets, with the values behind the status."""
    rest = "".join(f", {key}={value}" for key, value in values.items())
    return f'[mac_address=0x{address:04x}, status="{status}"{rest}]'


def session_info_ntf(block: int, records: Sequence[str]) -> str:
    """Return the notification, one line longer than its peers."""
    head = f"SESSION_INFO_NTF: {{session_handle=1, sequence_number={block}, block_index={block}"
    return f"{head}, n_measurements={len(records)}\n " + ";\n ".join(records) + "}"


class QorvoCli(Emulator):
    """A DWM3001CDK or QM33 kit; angles to the right and upwards, in hundredths of a degree."""

    name = "qorvo_cli"
    title = "Qorvo QM33 and DW3xxx CLI, SESSION_INFO_NTF"
    names = "0x{0:04x}"
    antenna = "two_axis"
    measures = "both"
    rate_hz = 5.0
    banner = lines(["ok", 'SESSION_STATUS_NTF: {state="ACTIVE", reason="State change"}'])

    def encode(self, asked: Round) -> bytes:
        """Return a notification with all peers."""
        records = [self._record(answer) for answer in asked.answers]
        text = session_info_ntf(self.next_number(), records)
        return lines(text.split("\n"))

    def _record(self, answer: Answer) -> str:
        if answer.heard is None or answer.range_m is None:
            return qorvo_record(answer.emitter_id, {}, "RX_TIMEOUT")
        values = {"distance[cm]": str(round(100.0 * answer.range_m))}
        for side, angle_rad in (("az", answer.azimuth_rad), ("el", answer.elevation_rad)):
            if angle_rad is not None:
                phase_deg = 180.0 * math.sin(angle_rad)
                values[f"loc_{side}_pdoa"] = f"{phase_deg:.2f}"
                values[f"loc_{side}"] = f"{math.degrees(angle_rad):.2f}"
        return qorvo_record(answer.emitter_id, values)


def js_frame(value: Mapping[str, object], *, after_colon: str = "") -> str:
    """Return `JS`, the length in hexadecimal, JSON."""
    text = json.dumps(value, separators=(",", ":"))
    if after_colon:  # after the first colon there may be a space, and nowhere else
        text = text.replace(":", ":" + after_colon, 1)
    return f"JS{len(text):04X}{text}"


class PdoaJs(Emulator):
    """A node of two antennas; X to the right, Y along boresight, whole centimetres."""

    name = "pdoa_js"
    title = "Decawave PDoA kit and Makerfabs MaUWB_AOA, JS frames"
    names = "{0:04X}"
    antenna = "line"
    measures = "both"
    banner = lines([js_frame({"SN": {"a16": "0001", "V": 1, "X": 12, "Y": -31, "Z": 1003}})])
    """The frame by which the node introduces itself."""

    def encode(self, asked: Round) -> bytes:
        """Return a frame for each tag that answered."""
        number, time_us = self.next_number(256), round(1e6 * asked.sent_at_s) % SUPERFRAME_US
        return lines(
            [
                js_frame({"TWR": self._twr(answer, number, time_us)}, after_colon=" ")
                for answer in asked.heard
                if answer.range_m is not None
            ]
        )

    def _twr(self, answer: Answer, number: int, time_us: int) -> dict[str, object]:
        range_cm, angle_rad = 100.0 * (answer.range_m or 0.0), answer.azimuth_rad
        x_cm = y_cm = phase_mrad = 0
        if angle_rad is not None:
            x_cm, y_cm = (
                round(range_cm * math.sin(angle_rad)),
                round(range_cm * math.cos(angle_rad)),
            )
            phase_mrad = round(1e3 * math.pi * math.sin(angle_rad))
        ranged = {"R": number, "T": time_us, "D": round(range_cm), "P": phase_mrad}
        located = {"Xcm": x_cm, "Ycm": y_cm, "O": 14, "V": 1, "X": 12, "Y": -31, "Z": 1003}
        return {"a16": self.name_on_wire(answer.emitter_id), **ranged, **located}


def at_range(
    tag: int,
    mask: int,
    sequence: int,
    ranges_cm: Sequence[int],
    rssi_dbm: Sequence[float] | None = None,
    anchors: Sequence[int] | None = None,
) -> str:
    """Return one AT+RANGE line of eight slots; anchor -1: the slot is empty."""
    text = f"AT+RANGE=tid:{tag},mask:{mask:02X},seq:{sequence}"
    text += f",range:({','.join(map(str, ranges_cm))})"
    if rssi_dbm is not None:
        text += f",rssi:({','.join(f'{dbm:.2f}' for dbm in rssi_dbm)})"
    if anchors is not None:
        text += f",ancid:({','.join(map(str, anchors))})"
    return text


class MakerfabsAt(Emulator):
    """A tag among eight anchors at most, whole centimetres."""

    name = "makerfabs_at"
    title = "Makerfabs MaUWB_DW3000, AT firmware"
    most = SLOTS
    ids = range(256)
    banner = lines(["OK"])

    def encode(self, asked: Round) -> bytes:
        """Return a line in any case; 0 for one that did not answer."""
        slots = enumerate(asked.answers)
        heard = {slot: answer for slot, answer in slots if answer.range_m is not None}
        ranges_cm = [0] * SLOTS
        anchors = [-1] * SLOTS
        for slot, answer in heard.items():
            ranges_cm[slot] = clamped(100.0 * (answer.range_m or 0.0), 0, 65_535)
            anchors[slot] = answer.emitter_id
        mask, sequence = sum(1 << slot for slot in heard), self.next_number(256)
        return lines([at_range(0, mask, sequence, ranges_cm, anchors=anchors)])

    def hear(self, data: bytes) -> bytes:
        """Return OK for every command."""
        return lines(["OK"] * data.count(b"AT+"))


@dataclass(frozen=True, slots=True)
class Fresh:
    """Measurement that has not been fetched yet."""

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
        """Return `+OK` at once; the tag's payload and the distance once it has answered."""
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
