"""`companion radio identify`: the emulated radio's name, and none for noise."""

from __future__ import annotations

import numpy as np
import pytest

from companion.domain import RangingMeasurement
from companion.radio_tools.identify import Attempt, Listener, attempts, identify
from sim_link.emulators.catalogue import make_emulator
from sim_link.emulators.emulator import Answer, Round
from tests.radio_formats import FORMATS, Format

NAMED = [each for each in FORMATS if each.radio != "lines"]
ALSO = {"ftm_csv": {"esp32_ftm"}}
"""Formats that two decoders share."""


def printed(format_: Format) -> bytes:
    """Ten seconds at the radio's own rate."""
    emulator = make_emulator(format_.name, 3)
    said = emulator.boot()
    for number in range(round(10.0 * emulator.rate_hz)):
        now_s = 1.0 + number / emulator.rate_hz
        heard = RangingMeasurement(
            emitter_id=1,
            measured_at_s=now_s,
            range_m=20.0 + 0.1 * number if "range" in emulator.gives else None,
            range_sigma_m=0.5,
            bearing_body_rad=0.2 + 0.01 * (number % 9),
            elevation_rad=-0.1,
            is_array_angle=emulator.antenna in ("line", "two_axis"),
            quality=0.8,
        )
        said += emulator.say(Round(now_s, (Answer(1, heard),)))
    return said


@pytest.mark.parametrize("format_", NAMED, ids=lambda each: str(each.name))
def test_each_emulated_radio_is_named(format_: Format) -> None:
    listener = Listener()
    data = printed(format_)
    for at in range(0, len(data), 512):
        listener.feed(data[at : at + 512], at / 512.0)

    found = listener.found
    assert found is not None
    assert found.name in {format_.radio} | ALSO.get(format_.radio, set())


@pytest.mark.parametrize("seed", range(3))
def test_noise_is_no_radio(seed: int) -> None:
    rng = np.random.default_rng(seed)
    letters = bytes(range(0x20, 0x7F)) + b"\r\n"
    text = bytes(letters[k] for k in rng.integers(0, len(letters), 40_000))
    for data in (rng.bytes(40_000), text, b"1,2,3,4\n" * 400, b"hello 12.5 m\r\n" * 400):
        listener = Listener()
        listener.feed(data, 0.0)
        assert listener.found is None, listener.found


def test_the_speed_of_a_serial_port_is_tried_and_said() -> None:
    data = printed(next(each for each in FORMATS if each.name == "nlink_node3"))

    def hear(attempt: Attempt, listener: Listener) -> None:
        listener.feed(data if attempt.baud == 921_600 else bytes(len(data)), 0.0)

    code, text = identify("/dev/ttyUSB0", hear=hear)
    assert code == 0
    assert "at 921600 baud" in text
    assert text.endswith("companion radio watch 'nlink@serial:/dev/ttyUSB0:921600'")
    assert sum(each.seconds for each in attempts("/dev/ttyUSB0", 10.0)) == pytest.approx(10.0)


def test_what_is_no_radio_is_said_with_what_was_heard() -> None:
    code, text = identify("udp:127.0.0.1:5005", hear=lambda _, ear: ear.feed(b"x" * 90, 0.0))
    assert (code, text.partition(" at ")[0]) == (1, "90 bytes")
    code, text = identify("udp:127.0.0.1:5005", hear=lambda *_: None)
    assert code == 1
    assert text.startswith("nothing heard at udp:127.0.0.1:5005 in 10 s")
