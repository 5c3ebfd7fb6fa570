"""`companion radio identify`: each emulated radio's name in its time, and none for noise."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from companion.domain import RangingMeasurement
from companion.mav.endpoint import Chunk
from companion.radio_tools.identify import (
    LISTEN_S,
    Attempt,
    Listener,
    RadioListener,
    attempts,
    identify,
)
from companion.radios.decoder import radio_kind
from sim_link.emulators.catalogue import make_emulator
from sim_link.emulators.emulator import Answer, Emulator, Round
from tests.radio_formats import ALL, FORMATS, Format

NAMED = [each for each in ALL if each.radio != "lines"]
ALSO = {"ftm_csv": {"esp32_ftm"}}
"""Formats that two decoders share."""
STEP_S = 0.05
OTHER_SPEED = np.random.default_rng(0).bytes(1 << 16)
"""Bytes that a serial port reads at another speed."""
URLS = {
    "serial": "/dev/ttyUSB0",
    "http": "http://127.0.0.1:8081",
    "wss": "ws://127.0.0.1:1",
    "exec": "exec:radio",
}
"""Addresses at which a radio is searched, by its usual transport; others by UDP."""


def round_at(emulator: Emulator, now_s: float, number: int) -> Round:
    """A round with one emitter that answers."""
    heard = RangingMeasurement(
        emitter_id=1,
        measured_at_s=now_s,
        range_m=20.0 + 0.1 * number,
        range_sigma_m=0.5,
        bearing_body_rad=0.2 + 0.01 * (number % 9),
        elevation_rad=-0.1,
        is_array_angle=emulator.antenna in ("line", "two_axis"),
        quality=0.8,
        power_dbm=-71.0,
    )
    return Round(now_s, (Answer(1, heard),))


class Bench:
    """An emulated radio on a desk, in invented time."""

    def __init__(self, name: str, radio: str, rate_hz: float | None = None) -> None:
        self.now_s = 0.0
        self.emulator = make_emulator(name, 3)
        self.kind = radio_kind(radio)
        self._period_s = 1.0 / (rate_hz or self.emulator.rate_hz)
        self._rounds = self._output()
        scheme, _, speed = self.kind.transport.partition(":")
        self._baud = int(speed) if scheme == "serial" else None
        self.url = URLS.get(scheme, "udp:127.0.0.1:5005")

    def clock(self) -> float:
        return self.now_s

    def _output(self) -> Iterator[bytes]:
        """Yield all that it printed since the last call."""
        number, due_s = 0, 0.0
        yield self.emulator.banner
        while True:
            said = b""
            while due_s <= self.now_s:
                said += self.emulator.encode(round_at(self.emulator, 1.0 + due_s, number))
                number, due_s = number + 1, due_s + self._period_s
            yield said

    def _printed(self, attempt: Attempt) -> bytes:
        data = next(self._rounds)
        if attempt.baud is not None and attempt.baud != self._baud:
            return OTHER_SPEED[: len(data)]
        poll = radio_kind(attempt.radio).poll
        if self.emulator.request and poll is not None and attempt.radio == self.kind.name:
            data += self.emulator.hear(poll.request or poll.probe)
        is_page = attempt.url.startswith("http")
        return b"" if is_page and attempt.radio != self.kind.name else data

    def hear(self, attempt: Attempt, listener: Listener) -> None:
        began_s = self.now_s
        listening = RadioListener(listener, attempt.share_s, attempt.most_s)
        while not listening.is_finished:
            self.now_s += STEP_S
            listening.handle_timer(self.now_s - began_s)
            if data := self._printed(attempt):
                listening.receive(Chunk(0, data, is_datagram=False), self.now_s - began_s)


def printed(format_: Format) -> bytes:
    """Ten seconds at the radio's own rate."""
    emulator = make_emulator(format_.name, 3)
    said = emulator.banner
    for number in range(round(10.0 * emulator.rate_hz)):
        said += emulator.say(round_at(emulator, 1.0 + number / emulator.rate_hz, number))
    return said


@pytest.mark.parametrize("format_", NAMED, ids=lambda each: str(each.name))
def test_each_emulated_radio_is_named_in_ten_seconds(format_: Format) -> None:
    """It is plugged in with its own speed and rate, and polled if it must be."""
    bench = Bench(format_.name, format_.radio)

    code, text = identify(bench.url, hear=bench.hear, clock=bench.clock)

    assert code == 0, text
    assert text.partition(":")[0] in {format_.radio} | ALSO.get(format_.radio, set())
    assert bench.now_s <= LISTEN_S + STEP_S


@pytest.mark.parametrize("name", ["esp32_ftm", "sx1280", "qorvo_cli"])
def test_a_slow_radio_is_waited_for_once_it_has_measured(name: str) -> None:
    bench = Bench(name, name, rate_hz=0.4)

    code, text = identify(bench.url, hear=bench.hear, clock=bench.clock)

    assert (code, text.partition(":")[0]) == (0, name)


def test_a_module_that_must_know_whom_to_ask_names_itself() -> None:
    for name in ("ryuw122", "pozyx"):
        bench = Bench(name, name)
        code, text = identify(bench.url, hear=bench.hear, clock=bench.clock)
        assert code == 0
        assert f"watch '{name}:tag=NAME@serial:/dev/ttyUSB0:115200'" in text


def test_a_radio_that_prints_powers_beside_its_ranges_is_named() -> None:
    """A console has much to say before the first range comes."""
    now_s = 0.0

    def hear(attempt: Attempt, listener: Listener) -> None:
        nonlocal now_s
        listening = RadioListener(listener, attempt.share_s, attempt.most_s)
        while not listening.is_finished:
            now_s += STEP_S
            listening.handle_timer(now_s)
            line = "I (9) wifi:state: run, rssi: -61\n"
            if now_s % 4.0 < STEP_S:
                line = (
                    "I (9) ftm_station: Estimated RTT - 33 nSec, Estimated Distance - 5.07 meters\n"
                )
            listening.receive(Chunk(0, line.encode(), is_datagram=False), now_s)

    code, text = identify("/dev/ttyUSB0", hear=hear, clock=lambda: now_s)

    assert (code, text.partition(":")[0]) == (0, "esp32_ftm")


def noise_of(letters: bytes) -> Callable[[int], bytes]:
    rng = np.random.default_rng(7)
    return lambda count: bytes(letters[k] for k in rng.integers(0, len(letters), count))


@pytest.mark.parametrize(
    "letters", [bytes(range(256)), bytes(range(0x20, 0x7F)) + b"\r\n"], ids=["bytes", "text"]
)
@pytest.mark.parametrize("url", ["/dev/ttyUSB0", "serial:/dev/ttyUSB0:115200", "udp:127.0.0.1:1"])
def test_noise_ends_within_the_time_and_is_no_radio(letters: bytes, url: str) -> None:
    now_s, noise = 0.0, noise_of(letters)

    def hear(attempt: Attempt, listener: Listener) -> None:
        nonlocal now_s
        began_s, listening = now_s, RadioListener(listener, attempt.share_s, attempt.most_s)
        while not listening.is_finished:
            now_s += STEP_S
            listening.handle_timer(now_s - began_s)
            listening.receive(Chunk(0, noise(576), is_datagram=False), now_s - began_s)

    code, text = identify(url, hear=hear, clock=lambda: now_s)

    assert code == 1
    assert "from no known radio" in text
    assert now_s <= LISTEN_S + STEP_S


def test_a_link_that_opens_slowly_takes_its_time_from_the_others() -> None:
    now_s = 0.0

    def hear(attempt: Attempt, _: Listener) -> None:
        nonlocal now_s
        now_s += 0.4 + attempt.share_s

    identify("/dev/ttyUSB0", hear=hear, clock=lambda: now_s)

    ways = len(attempts("/dev/ttyUSB0"))
    assert LISTEN_S <= now_s <= LISTEN_S + 0.4 * ways


NMEA = b"$GNGGA,120001.00,4723.86219,N,00832.73629,E,1,12,0.78,488.1,M,47.3,M,,*6A\r\n"
HEARTBEAT = bytes.fromhex("fd09000007010100000000000000020c5104030f5e")
MODEM = b'AT+CSQ\r\r\n+CSQ: 21,99\r\n\r\nOK\r\n+COPS: 0,0,"Operator",7\r\nERROR\r\n'
KERNEL = (
    b"[    0.000000] Booting Linux on physical CPU 0x0000000000 [0x410fd083]\n"
    b"[    3.412043] usb 1-1.2: new full-speed USB device number 4 using xhci_hcd\n"
    b"[   11.201187] wlan0: Limiting TX power to 20 (20 - 0) dBm as advertised\n"
    b"[   12.300000] cfg80211: failed to load, device 3, range 12\n"
    b"[   13.000000] hci0: link lost, last RSSI -67\n"
)
OTHERS = (NMEA, HEARTBEAT, MODEM, KERNEL, b"12|34|56\r\n82|82|56\r\n1234|82|56\r\n")
"""Output of other devices; the last one is three columns of an unknown program."""


@pytest.mark.parametrize("said", OTHERS, ids=["nmea", "mavlink", "modem", "kernel", "columns"])
def test_other_devices_are_no_radio(said: bytes) -> None:
    listener = Listener()
    listener.feed(said * 300, 0.0)

    assert listener.found is None
    assert listener.found_by_power is None
    assert listener.refusing is None


@pytest.mark.parametrize("seed", range(3))
def test_noise_is_no_radio(seed: int) -> None:
    rng = np.random.default_rng(seed)
    letters = bytes(range(0x20, 0x7F)) + b"\r\n"
    text = bytes(letters[k] for k in rng.integers(0, len(letters), 40_000))
    for data in (rng.bytes(40_000), text, b"1,2,3,4\n" * 400, b"hello 12.5 m\r\n" * 400):
        listener = Listener()
        listener.feed(data, 0.0)
        assert listener.found is None, listener.found
        assert listener.found_by_power is None, listener.found_by_power
        assert listener.refusing is None, listener.refusing


def test_the_speed_of_a_serial_port_is_tried_and_said() -> None:
    data = printed(next(each for each in FORMATS if each.name == "nlink_node3"))

    def hear(attempt: Attempt, listener: Listener) -> None:
        listener.feed(data if attempt.baud == 921_600 else bytes(len(data)), 0.0)

    code, text = identify("/dev/ttyUSB0", hear=hear)
    assert code == 0
    assert "at 921600 baud" in text
    assert text.endswith("companion radio watch 'nlink@serial:/dev/ttyUSB0:921600'")


def test_what_is_no_radio_is_said_with_what_was_heard() -> None:
    code, text = identify(
        "udp:127.0.0.1:5005", hear=lambda _, listening: listening.feed(b"x" * 90, 0.0)
    )
    assert (code, text.partition(" at ")[0]) == (1, "90 bytes")
    code, text = identify("udp:127.0.0.1:5005", hear=lambda *_: None)
    assert code == 1
    assert text.startswith("nothing heard at udp:127.0.0.1:5005 in 10 s")


def said_of(line: bytes) -> tuple[int, str]:
    """Code and report for a hundred lines at one address."""
    return identify("udp:127.0.0.1:5005", hear=lambda _, heard: heard.feed(line * 100, 0.0))


def test_what_a_radio_refuses_is_named_with_the_reason() -> None:
    lost = b'{"Block":1, "results":[{"Addr":"0x0001","Status":"RX_TIMEOUT","D_cm":0}]}\n'
    code, text = said_of(lost)
    assert code == 1
    assert text.endswith("at udp:127.0.0.1:5005, refused by qorvo_cli: status RX_TIMEOUT 100")


@pytest.mark.parametrize(
    ("line", "command"),
    [
        (b"RSSI: -61\n", "'rssi:single_emitter=true@udp:127.0.0.1:5005'"),
        (b"10:22:33:44:55:66 RSSI: -61\n", "'rssi@udp:127.0.0.1:5005'"),
        (b"time,distance\n1,2000\n", "'android_rtt:unit=mm,single_emitter=true@udp:"),
    ],
)
def test_the_command_has_the_options_that_the_output_needs(line: bytes, command: str) -> None:
    code, text = said_of(line)
    assert code == 0
    assert f"companion radio watch {command}" in text
    assert text.endswith("check them") == ("true" in command)


def test_a_log_is_read_from_its_first_line_which_names_the_columns(tmp_path: Path) -> None:
    path = tmp_path / "walk.csv"
    path.write_bytes(printed(next(each for each in ALL if each.name == "android_rtt")))

    code, text = identify(f"file:{path}", seconds=5.0)

    assert code == 0, text
    assert text.startswith("android_rtt: ")
    assert f"file:{path}?play=1'" in text


def test_a_file_that_grows_is_followed_when_its_beginning_says_nothing() -> None:
    first, second = attempts("file:log.txt")
    assert (first.url, second.url) == ("file:log.txt?play=10", "file:log.txt")
    assert [each.url for each in attempts("file:log.txt?play=2")] == ["file:log.txt?play=2"]
