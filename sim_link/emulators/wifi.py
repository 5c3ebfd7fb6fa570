"""Wi-Fi round-trip times: ESP32 consoles, lines that users print, `iw`, Android.

A distance is half the way that light goes in the round-trip time. None measures a direction.

Sources: Espressif, esp-idf `examples/wifi/ftm` and arduino-esp32 `FTM`; GTEC, esp32s2-ftm-tag; B.
Greear, iw-ct `event.c`; Android reference, `RangingResult`.
"""

from __future__ import annotations

from collections.abc import Sequence

from sim_link.emulators.emulator import (
    SIMULATION_BEGAN_S,
    U32,
    Answer,
    Emulator,
    LineEmulator,
    RangeLines,
    Round,
    clamped,
    lines,
    mac_of,
    round_trip_s,
)

FRAMES = 31
"""Valid frames of 32 requested, the most possible."""
UNUSED_SIGMA_M = 0.5


def esp_log(level: str, clock_ms: int | None, text: str, *, is_coloured: bool = True) -> str:
    """Return a line of esp-idf's log: green for information, brown for warnings, red for errors."""
    stamp = "" if clock_ms is None else f"({clock_ms}) "
    line = f"{level} {stamp}{text}"
    colour = {"I": "32", "W": "33", "E": "31"}[level]
    return f"\x1b[0;{colour}m{line}\x1b[0m" if is_coloured else line


def ftm_estimate(range_m: float) -> tuple[int, int]:
    """Return the centimetres and whole nanoseconds that esp-idf's estimate holds."""
    cm = clamped(100.0 * range_m, 0, U32 - 1)
    return cm, int(1e9 * round_trip_s(cm / 100.0))


def esp_estimate(range_m: float) -> str:
    """Format the line of the station example."""
    cm, rtt_ns = ftm_estimate(range_m)
    return (
        f"ftm_station: Estimated RTT - {rtt_ns} nSec, "
        f"Estimated Distance - {cm // 100}.{cm % 100:02d} meters"
    )


def esp_session(valid: int, asked: int, rtt_ns: float, rssi_dbm: int) -> str:
    """Format the driver's line that precedes it."""
    return (
        f"wifi:FTM session ends with {valid} valid readings out of {asked}, "
        f"Avg raw RTT: {rtt_ns:.3f} nSec, Avg RSSI: {rssi_dbm}"
    )


class Esp32Ftm(LineEmulator):
    """An ESP32-S2 or later with the station example of esp-idf, one responder after the other."""

    name = "esp32_ftm"
    title = "ESP32 Wi-Fi FTM, console of esp-idf"
    names = "{mac}"
    rate_hz = 2.0
    prints_silence = True
    banner = b"\xe3\x9c\x00\xfe\r\n" + lines(
        [
            "ESP-ROM:esp32s2-rc4-20191025",
            "rst:0x1 (POWERON),boot:0x8 (SPI_FAST_FLASH_BOOT)",
            esp_log("I", 27, "boot: ESP-IDF v5.2 2nd stage bootloader"),
            "",
            "Type 'help' to get the list of commands.",
            "esp32s2> ",
        ]
    )
    """Messages of the boot loader, the first of them at another baud rate."""

    def lines_of(self, answer: Answer, asked: Round) -> list[str]:
        """Return the lines of a session."""
        clock_ms = self.device_ms(asked.sent_at_s) % U32
        mac = mac_of(answer.emitter_id)
        begin = [
            "Requesting FTM session with Frm Count - 32, Burst Period - 200mSec (0: No Preference)",
            esp_log("W", None, f"wifi:Starting FTM session with {mac} in 0.084 Sec"),
        ]
        if answer.range_m is None:
            failure = f"FTM procedure with Peer({mac}) failed! (Status - 5)"
            return [*begin, esp_log("E", None, "wifi:No valid FTM Measurements found!"), failure]
        valid = clamped(FRAMES * answer.quality, 1, FRAMES)
        raw_ns = max(0.0, 1e9 * round_trip_s(answer.range_m))
        session = esp_session(valid, FRAMES, raw_ns, round(answer.power_dbm))
        return [
            *begin,
            esp_log("W", clock_ms, session),
            esp_log("I", clock_ms, esp_estimate(answer.range_m)),
        ]


def arduino_estimate(range_m: float) -> str:
    """Format the line of the Arduino example."""
    cm, rtt_ns = ftm_estimate(range_m)
    return f"FTM Estimate: Distance: {cm / 100.0:.2f} m, Return Time: {rtt_ns} ns"


class Esp32Arduino(RangeLines):
    """The Arduino example, whose output has neither names nor a clock."""

    name = "esp32_arduino"
    title = "ESP32 Wi-Fi FTM, Arduino example"
    names = ""
    rate_hz = 2.0
    most = 1
    banner = lines(["ESP-ROM:esp32s2-rc4-20191025", "Connecting to FTM Access Point", "....."])
    silence = ("FTM Error: FAIL",)

    def lines_at(self, range_m: float, answer: Answer, clock_ms: int) -> list[str]:  # noqa: ARG002
        """Return the estimate alone."""
        return [arduino_estimate(range_m)]


def gtec_row(anchor_id: int, range_m: float, frames: Sequence[tuple[int, int]]) -> str:
    """Return anchor, estimated and raw round trip in ns, centimetres, and ps, dBm per frame."""
    cm, rtt_ns = ftm_estimate(range_m)
    row = f"{anchor_id},{rtt_ns},{rtt_ns},{cm},{len(frames)},"
    return row + "".join(f"{rtt_ps},{rssi},0,0,0,0," for rtt_ps, rssi in frames)


class FtmCsv(RangeLines):
    """GTEC's tag firmware: one row for each anchor that answered."""

    name = "ftm_csv"
    title = "ESP32 Wi-Fi FTM, rows of GTEC's esp32s2-ftm-tag"
    rate_hz = 2.0

    def lines_at(self, range_m: float, answer: Answer, clock_ms: int) -> list[str]:  # noqa: ARG002
        """Return a row of four frames."""
        rtt_ps = max(0, round(1e12 * round_trip_s(range_m)))
        frames = [(rtt_ps, round(answer.power_dbm))] * 4
        return [gtec_row(answer.emitter_id, range_m, frames)]


def iw_burst(
    mac: str, boot_ns: int, rssi: int, rtt_ps: int, variance_ps2: int, spread_ps: int
) -> list[str]:
    """Return the lines of `iw` for one peer; a power is printed as if it had no sign."""
    fields = {
        "BURST_INDEX": 0,
        "NUM_BURSTS_EXP": 0,
        "BURST_DURATION": 0,
        "FTMS_PER_BURST": 0,
        "RSSI_AVG": rssi % U32,
        "RSSI_SPREAD": 0,
        "RTT_AVG": rtt_ps,
        "RTT_VARIANCE": variance_ps2,
        "RTT_SPREAD": spread_ps,
    }
    head = f"  Peer {mac}: status=0 (SUCCESS) @{boot_ns} tsf=0"
    return [head, "    FTM", *(f"      {key}: {value}" for key, value in fields.items())]


def iw_failure(mac: str, boot_ns: int, reason: str = "NO_RESPONSE (1)") -> list[str]:
    """Format the lines of `iw` for a peer that did not answer."""
    head = f"  Peer {mac}: status=3 (FAILURE) @{boot_ns} tsf=0"
    return [head, f"    FTM failed: {reason}"]


class IwFtm(Emulator):
    """`iw dev wlan0 measurement ftm_request`, run once for each round."""

    name = "iw_ftm"
    title = "Linux iw, measurement ftm_request"
    names = "{mac}"
    rate_hz = 1.0

    def encode(self, asked: Round) -> bytes:
        """Return a run: its head, each peer, its end."""
        boot_ns = round(1e9 * self.device_s(asked.sent_at_s))
        cookie = self.next_number() + 1
        texts = [f"wdev 0x1 (phy #0): Peer measurements (cookie {cookie}):"]
        for answer in asked.answers:
            texts += self._peer(answer, boot_ns)
        texts.append("wdev 0x1 (phy #0): peer measurement complete")
        return "".join(text + "\n" for text in texts).encode()

    def _peer(self, answer: Answer, boot_ns: int) -> list[str]:
        mac, heard = mac_of(answer.emitter_id), answer.heard
        if heard is None or heard.range_m is None:
            return iw_failure(mac, boot_ns)
        sigma_m = UNUSED_SIGMA_M if heard.range_sigma_m is None else heard.range_sigma_m
        spread_ps = 1e12 * round_trip_s(sigma_m)
        rtt_ps = round(1e12 * round_trip_s(heard.range_m))
        rssi, variance_ps2 = round(answer.power_dbm), round(spread_ps * spread_ps)
        return iw_burst(mac, boot_ns, rssi, rtt_ps, variance_ps2, round(spread_ps))


ANDROID_HEADER = (
    "timestamp,session,ssid,bssid,distance_mm,std_dev_mm,rssi,attempted,successful"  # no standard
)


ATTEMPTED = 8


def rtt_row(
    epoch_ms: int,
    bssid: str,
    distance_mm: int = 0,
    std_dev_mm: int = 0,
    rssi_dbm: int = -127,
    successful: int = 0,
) -> str:
    """Return a row that an Android program logs, in the order of the header."""
    ranged = f"{distance_mm},{std_dev_mm},{rssi_dbm}"
    return f"{epoch_ms},1,Lost,{bssid},{ranged},{ATTEMPTED},{successful}"


class AndroidRtt(LineEmulator):
    """A telephone that asks access points, eight frames each."""

    name = "android_rtt"
    title = "Android Wi-Fi RTT, rows of a logging program"
    names = "{mac}"
    rate_hz = 5.0
    epoch_s = SIMULATION_BEGAN_S
    prints_silence = True
    banner = lines([ANDROID_HEADER])

    def lines_of(self, answer: Answer, asked: Round) -> list[str]:
        """Return a row, answered or not."""
        epoch_ms = self.device_ms(asked.sent_at_s)
        mac, heard = mac_of(answer.emitter_id), answer.heard
        if heard is None or heard.range_m is None:
            return [rtt_row(epoch_ms, mac)]
        range_mm, sigma_mm = round(1e3 * heard.range_m), round(1e3 * (heard.range_sigma_m or 0.0))
        successful = clamped(ATTEMPTED * answer.quality, 2, ATTEMPTED)
        return [rtt_row(epoch_ms, mac, range_mm, sigma_mm, round(answer.power_dbm), successful)]
