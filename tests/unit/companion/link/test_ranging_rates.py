"""MAVLink ranging beyond its rates is left out, counted and announced."""

from __future__ import annotations

import math

import pytest

from companion.link.conversion.clock_sync import ClockSync
from companion.link.conversion.sender_clock import VehicleClock
from companion.link.ranging_sources import (
    MAX_EMITTERS,
    RATE_MAX_HZ,
    MavlinkRanging,
)
from companion.mav.codec import MavCodec
from companion.mav.dialect import MAVLink_radio_ranging_message

NAN = math.nan
FLOOD_S = 10.0


class Line:
    """A ranging link with any senders."""

    def __init__(self) -> None:
        self.source = MavlinkRanging(MavCodec(1, 191), VehicleClock(ClockSync()))

    def passes(
        self, now_s: float, emitter_id: int = 7, component: int = 158, stamp: int = 0
    ) -> int:
        """Return the number of measurements that go on, of one that is sent now."""
        message = MAVLink_radio_ranging_message(
            stamp, 80.0, 1.0, 0.5, 0.1, NAN, NAN, emitter_id, 255, 0
        )
        return len(self.source.receive(MavCodec(1, component).encode(message), now_s))


@pytest.mark.parametrize("rate_hz", [100, 300, 1000])
@pytest.mark.parametrize("stamp_step_us", [0, 1_000_000_000])
def test_a_sender_that_floods_is_thinned_to_the_rate(rate_hz: int, stamp_step_us: int) -> None:
    line = Line()
    count = int(rate_hz * FLOOD_S)
    stamps = (stamp_step_us * (1 + i) for i in range(count))  # its own clock refills nothing
    passed = sum(line.passes(i / rate_hz, stamp=stamp) for i, stamp in enumerate(stamps))
    assert RATE_MAX_HZ * FLOOD_S <= passed <= RATE_MAX_HZ * (FLOOD_S + 1.0)


def test_ids_that_change_with_every_message_refill_nothing() -> None:
    line = Line()
    passed = sum(line.passes(i / 1000.0, emitter_id=i % 5000) for i in range(10_000))
    assert passed <= RATE_MAX_HZ * MAX_EMITTERS * (FLOOD_S + 1.0)


def test_a_flood_takes_nothing_from_another_sender() -> None:
    line = Line()
    heard = 0
    for tick in range(10_000):
        line.passes(tick / 1000.0, component=42)
        if tick % 100 == 0:
            heard += line.passes(tick / 1000.0)
    assert heard == 100


def test_sixteen_emitters_at_ten_hertz_and_a_stall_of_a_second_lose_nothing() -> None:
    line = Line()
    for tick in range(100):
        now_s = 2.0 if 10 <= tick < 20 else tick / 10.0  # what waited arrives at once
        assert [line.passes(now_s, emitter_id=each) for each in range(16)] == [1] * 16
    assert line.source.texts(11.0) == []


def test_what_is_left_out_is_announced_once_in_thirty_seconds_with_its_sender() -> None:
    line = Line()
    texts = []
    for tick in range(59_000):
        line.passes(tick / 1000.0, component=42)
        if tick % 50 == 0:
            texts += line.source.texts(tick / 1000.0)
    assert len(texts) == 2
    assert texts[0].text.startswith("ranging of 1/42: ")
    assert texts[0].text.endswith(" skipped, over 20 Hz per emitter; lower its rate")
