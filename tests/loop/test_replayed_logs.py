"""Recorded links are played to a companion that cannot change them: few texts, whatever they hold.

The logs are made here, as a ground station writes them: eight bytes of microseconds since 1970, and
the frame. What is strange in them was seen in logs of real flights.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from companion.config.schema import CompanionConfig
from companion.flight_setup import build_endpoint
from companion.link.inbound import UNREAD
from companion.mav.codec import MavCodec, message_id
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Chunk
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from sim_link.lab.lockstep import MemoryJournal
from sim_link.lab.observer import Frame, Observer
from tests.loop.loop_helpers import AUTO, SELDOM, Loop

FLAVOURS: tuple[FlavourName, ...] = ("px4", "ardupilot")
LASTS_S, HALF_S = 90.0, 0.25
"""Duration of a log; half a period of a state that flaps at 2 Hz."""
BYTES_A_MINUTE = 1000
UNIX_S = 1_700_000_000
PEER = ("127.0.0.1", 14580)
STAMP = struct.Struct(">Q")
Change = Callable[[Message, float], Message | None]
"""A message of the log, at a time, as it was recorded; None if it is missing."""


class Recorded(Observer):
    """Log of what the vehicle sends."""

    def __init__(self) -> None:
        self.data = bytearray()

    def vehicle_sent(self, frame: Frame) -> None:
        if message_id(frame.data) not in UNREAD:  # most of the bytes, and none is decoded
            self.data += STAMP.pack(round((UNIX_S + frame.time_s) * 1e6)) + frame.data


def frames_of(data: bytes) -> Iterator[tuple[float, bytes]]:
    """Times and frames of a log."""
    at = 0
    while at < len(data):
        (micros,) = STAMP.unpack_from(data, at)
        length = 12 + data[at + 9]
        yield micros / 1e6 - UNIX_S, data[at + 8 : at + 8 + length]
        at += 8 + length


@pytest.fixture(scope="module", params=FLAVOURS)
def log(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A search that another companion flew, with take-off, OFFBOARD or GUIDED, and its end."""
    scenario = Scenario(autopilot=AutopilotParams(flavour=request.param), payload=SELDOM)
    loop, recorded = Loop(AUTO, scenario, seed=4), Recorded()
    loop.flight.observers.append(recorded)
    loop.run(LASTS_S)
    path: Path = tmp_path_factory.mktemp("logs") / f"{request.param}.tlog"
    path.write_bytes(recorded.data)
    return path


def is_second_half(now_s: float) -> bool:
    return int(now_s / HALF_S) % 2 == 1


def position_stops(message: Message, now_s: float) -> Message | None:
    is_position = message.get_type() == "LOCAL_POSITION_NED"
    return None if is_position and is_second_half(now_s) else message


def position_flips(message: Message, now_s: float) -> Message | None:
    """Alternates between two positions, 8 m apart, as of two estimators that take turns."""
    if isinstance(message, mavlink.MAVLink_local_position_ned_message) and is_second_half(now_s):
        message.x += 8.0
    return message


def height_flips(message: Message, now_s: float) -> Message | None:
    if isinstance(message, mavlink.MAVLink_local_position_ned_message) and is_second_half(now_s):
        message.z -= 4.0
    return message


def without_home(message: Message, now_s: float) -> Message | None:
    return None if message.get_type() == "HOME_POSITION" else position_stops(message, now_s)


def origin_flips(message: Message, now_s: float) -> Message | None:
    if isinstance(message, mavlink.MAVLink_gps_global_origin_message) and is_second_half(now_s):
        message.latitude += 900
    return message


def fix_flips(message: Message, now_s: float) -> Message | None:
    if isinstance(message, mavlink.MAVLink_gps_raw_int_message) and is_second_half(now_s):
        message.fix_type = mavlink.GPS_FIX_TYPE_NO_FIX
    return message


def landed_flips(message: Message, now_s: float) -> Message | None:
    if isinstance(message, mavlink.MAVLink_extended_sys_state_message) and is_second_half(now_s):
        message.landed_state = mavlink.MAV_LANDED_STATE_ON_GROUND
    return message


def mode_flips(message: Message, now_s: float) -> Message | None:
    """HEARTBEATs of 1 Hz, every second of them in another mode."""
    if isinstance(message, mavlink.MAVLink_heartbeat_message) and int(now_s) % 2 == 1:
        is_px4 = message.autopilot == mavlink.MAV_AUTOPILOT_PX4
        message.custom_mode = 0x03040000 if is_px4 else 5
    return message


def armed_flips(message: Message, now_s: float) -> Message | None:
    if isinstance(message, mavlink.MAVLink_heartbeat_message) and int(now_s) % 2 == 1:
        message.base_mode ^= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    return message


def clock_jumps(message: Message, now_s: float) -> Message | None:
    """Stamps that are a second ahead and back again."""
    if hasattr(message, "time_boot_ms") and is_second_half(now_s):
        message.time_boot_ms += 1000
    return message


def nothing_but_noise(message: Message, now_s: float) -> Message | None:
    """Return the message with all noise at once, except that of the clock."""
    for change in (position_flips, fix_flips, landed_flips, mode_flips, origin_flips):
        change(message, now_s)
    return without_home(message, now_s)


EVERY_DAY: tuple[Change, ...] = (nothing_but_noise,)
SLOW: tuple[Change, ...] = (
    *(position_stops, position_flips, height_flips, origin_flips, fix_flips, landed_flips),
    *(mode_flips, armed_flips, clock_jumps, without_home),
)
STRANGE = [*EVERY_DAY, *(pytest.param(change, marks=pytest.mark.slow) for change in SLOW)]


CHANGED_IDS = {
    *(mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, mavlink.MAVLINK_MSG_ID_HOME_POSITION),
    *(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN, mavlink.MAVLINK_MSG_ID_GPS_RAW_INT),
    *(mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, mavlink.MAVLINK_MSG_ID_HEARTBEAT),
    *(mavlink.MAVLINK_MSG_ID_ATTITUDE, mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT),
}


def most_text_bytes_a_minute(log: Path, change: Change) -> tuple[int, int]:
    """Bytes of STATUSTEXT in the worst minute of a companion that hears the log; their number."""
    endpoint = build_endpoint(CompanionConfig(), MemoryJournal())
    reader, writer = MavCodec(255, 190), mavlink.MAVLink(None, 1, 1)
    texts: list[tuple[float, int]] = []

    def collect(now_s: float) -> None:
        for chunk in endpoint.take_output():
            for message in reader.decode(chunk.data):
                if isinstance(message, mavlink.MAVLink_statustext_message):
                    texts.append((now_s, len(chunk.data)))

    for now_s, frame in frames_of(log.read_bytes()):
        while endpoint.next_timer_s() <= now_s:
            tick_s = max(0.0, endpoint.next_timer_s())
            endpoint.handle_timer(tick_s)
            collect(tick_s)
        if message_id(frame) in CHANGED_IDS:
            (message,) = reader.decode(frame)
            changed = change(message, now_s)
            writer.seq = frame[4]
            frame = b"" if changed is None else bytes(changed.pack(writer))
        if frame:
            endpoint.receive(Chunk(0, frame, PEER), now_s)
    sums = [sum(size for t, size in texts if at - 60.0 < t <= at) for at, _ in texts]
    return max(sums, default=0), len(texts)


@pytest.mark.parametrize("change", STRANGE, ids=lambda change: str(change.__name__))
def test_a_strange_log_makes_at_most_a_kilobyte_of_texts_a_minute(
    log: Path, change: Change
) -> None:
    most, count = most_text_bytes_a_minute(log, change)
    assert count > 0
    assert most <= BYTES_A_MINUTE
