"""Scans and sniffers that print received powers: Wi-Fi, Bluetooth, LoRa receivers, UAV-RT pulses.

A line belongs to the device whose address it has, or to that of the block that it stands in.
Without any address it is used only if all lines are from one emitter, which must be configured,
because the first device of a scan is seldom the one that is searched for.

Sources: `iw` scan.c, station.c and link.c; wireless-tools iwlist.c; wpa_supplicant ctrl_iface.c;
BlueZ client/main.c and monitor/packet.c; zephyr `samples/bluetooth/observer`; tcpdump
print-802_11.c; espressif/arduino-esp32 BLE `toString`; ESP32 promiscuous sketches after
lpodkalicki/blog; sandeepmistry/arduino-LoRa, jgromes/RadioLib, StuartsProjects/SX12XX-LoRa;
meshtastic/firmware `printPacket`; REYAX RYLR896 and RAK RUI3, AT commands; OpenWrt `iwinfo`;
espressif/esp-csi; airodump-ng; merbanan/rtl_433 `-M level`;
DonLakeFlyer/MavlinkTagController2 `PulseHandler` and `detector/pulse_detector.py`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from struct import Struct

from companion.domain import Params
from companion.radios.decoder import FrameDecoder, RadioReading, is_power_only
from companion.radios.fields import number, problem_of_spans
from companion.radios.line_forms import FormDecoder, form

_MAC = "[0-9A-Fa-f]{2}(?:[:-][0-9A-Fa-f]{2}){5}"
_ALONE = r"(?![\w-]|:\S)"
"""End of an address, behind which a colon may introduce its values."""
_EMITTER = f"(?P<emitter>{_MAC}){_ALONE}"
_TO = f"(?:(?!{_MAC}).)*?"
"""Rest of a line up to its other field: never the beginning of the next line, which follows at once
where bytes were lost."""
_BLOCK = f"(?P<block>{_MAC})"
_NUMBER = r"[+-]?[0-9]{1,3}(?:\.[0-9]+)?(?![.,:]?[0-9])"
_DBM = rf"(?P<power_dbm>{_NUMBER})"
MIN_MAC_LENGTH = 12
MIN_DBM = -114.0
"""Thermal noise in the bandwidth of Bluetooth, 1 MHz, the least of devices that have a MAC address;
lower ones, -127 or -128, stand for no value."""
_SETTING = (
    r"(?<![^\W_])(?:rssi|rx|signal)?(?:noise|background|interference|floor|thresh(?:old)?|limit"
    r"|cut-?off|filter|sensitivity|cca|min(?:imum)?|max(?:imum)?|above|below|under|than"
    r"|set(?:ting)?|default|configured|target|wanted|expected|ref(?:erence)?"
    r"|calibrated|measured|tx|transmit(?:ted)?|output|e?irp|erp"
    r"|rem(?:ote)?)(?:power|pwr|level|floor|rssi)?(?![^\W_])"
)
"""Words that make the level after them one that was not received here: a setting, noise, or what a
device transmits, or receives itself."""
NO_POWER = "no power in dBm that can be read: try `lines`"
A_SETTING = "level of a setting, of noise or of a transmitter: not received"
NOT_FRESH = "airodump-ng repeats old powers: read `tcpdump -e -l -i` of the same interface"
A_SHARE = "signal is a share, no dBm: use `iw dev wlan0 scan`"
NO_ADDRESS = "no address: set single_emitter=true if there is one emitter"


class PowerScanOptions(Params, frozen=True):
    """Properties that the lines leave open."""

    single_emitter: bool = False
    """True: all lines without an address are from one emitter."""


class PowerScanDecoder(FormDecoder):
    """Decoder of the lines of scans, sniffers and receivers."""

    Options = PowerScanOptions
    options: PowerScanOptions
    forms = (
        form(rf"^(?:BSS|Station|Connected to) {_BLOCK}"),
        form(rf"\b(?:Cell [0-9]+ - Address|Access Point): {_BLOCK}"),
        form(rf"^\s*(?:(?:(?:LE|BR/EDR) )?Address:|bdaddr) {_BLOCK}(?!.*\b(?:rssi|RSSI)\b)"),
        form(rf"^Device {_BLOCK}(?: \((?:public|random)\))?\s*$"),
        form(r"^(?P<end>[<>@=] |Discovered a peripheral)"),
        form(r"^\[[^\]]{1,64}\][#>]\s*$"),
        form(r"^\s*inactive time:\s+(?P<idle_ms>[0-9]{1,9}) ms"),
        form(r"^\s*(?:beacon )?signal avg:|^\s*(?:last |avg )?ack signal:|TX power: "),
        form(rf"^\s*signal:\s+(?P<signal>{_NUMBER}) (?:\[[-0-9, ]+\] )?dBm"),
        form(rf"\bSignal level={_DBM} dBm"),
        form(
            r"\bSignal level[=:][0-9]+/[0-9]+|^\s*[Ss]ignal\s*: [0-9]+(?:/[0-9]|%)| SIGNAL +BARS\b",
            A_SHARE,
        ),
        form(r"^ ?BSSID +(?:STATION +)?PWR |^(?:BSSID|Station MAC), First time seen, ", NOT_FRESH),
        form(
            r"(?i:\brssi\"?\s*:\s*-?[0-9.]+(?: dB)?,?\s*\"?snr\"?\s*:.*\bnoise\b)",
            "rssi of rtl_433 is relative to full scale: read it by `lines` as power_db",
        ),
        form(r"RSSI return value: ", "hcitool rssi is relative to an unknown level: use btmon"),
        form(rf"^\s*RSSI: {_DBM} dBm \(0x"),
        form(r"\bRSSI: (?:invalid|n/?a)", "no power"),
        form(
            rf"\[(?:CHG|NEW)\] Device {_EMITTER} RSSI: (?:is )?(?:0x[0-9a-fA-F]{{8}} \()?{_DBM}\)?$"
        ),
        form(r"^\s*RSSI: (?:0x[0-9a-fA-F]{8} \()?(?P<power_dbm>-[0-9]{1,3})\)?\s*$"),
        form(rf"(?:Device found|\[DEVICE\]): {_EMITTER} {_TO}RSSI {_DBM}"),
        form(rf"PACKET TYPE=\w+, CHAN=[0-9]+, RSSI={_DBM},(?:(?!RSSI=).)*?\bADDR2={_EMITTER}"),
        form(
            rf"{_DBM}dBm signal (?:[^:]{{0,40}}?dBm signal antenna [0-9]{{1,2}})*"
            rf"(?:(?!dBm signal).)*?\b(?:SA|TA):{_EMITTER}"
        ),
        form(r"dBm signal ", "frame without the sender's address: tcpdump -e prints it"),
        form(rf"\bAddress: {_EMITTER}{_TO}\b(?:rssi|RSSI): {_DBM}"),
        form(rf"^{_EMITTER}\t[0-9]{{4,5}}\t{_DBM}\t"),
        form(
            rf"^{_EMITTER}  {_DBM} dBm / \S+ dBm \(SNR -?[0-9]+\)  (?P<age_ms>[0-9]{{1,9}}) ms ago"
        ),
        form(rf"\bCSI_DATA,\w{{1,8}},{_EMITTER},(?P<power_dbm>-[0-9]{{1,3}}),"),
        form(
            r"\bLora RX \(id=\w+ fr=(?P<emitter>0x[0-9a-f]{8}) [^()]*\bHopLim=(?P<hops>[0-7]) "
            r"[^()]*\brxRSSI=(?P<power_dbm>-[0-9]{1,3}) [^()]*\bhopStart=(?P=hops)\b"
        ),
        form(r"\bLora RX \(id=", "a relay may have sent it: its power is of no known node"),
        form(r"\(id=0x[0-9a-f]+ fr=0x[0-9a-f]+ .*\brxRSSI="),
        form(
            r"\+RCV=(?P<emitter>[0-9]{1,5}),[0-9]{1,3},(?:(?!\+RCV).)*,(?P<power_dbm>-[0-9]{1,3}),"
            r"-?[0-9]{1,3}\s*$"
        ),
        form(r"^\+EVT:RXP2P:(?P<power_dbm>-[0-9]{1,3}):-?[0-9]{1,3}:"),
        form(rf"\bwith RSSI {_DBM}"),
        form(rf"^\[\w+\] RSSI:\s+{_DBM} dBm$"),
        form(rf"\bRSSI,{_DBM}dBm\b"),
    )
    _LEVELS = tuple(
        re.compile(pattern, re.IGNORECASE)
        for pattern in (
            r"\b(?:rx[ _]?)?(?:rssi|rss|signal|power|level)(?:[_ ]?(?:dbm|strength|level))?\b[\"']?"
            rf"[ \t]{{0,12}}[:=,]?[ \t]{{0,12}}{_DBM}(?![%/])",
            rf"(?<![\w.,+-]){_DBM} ?dBm\b(?! ?{_SETTING})",
        )
    )
    _LABEL = re.compile(rf"{_SETTING}[^,;|)\]}}\t0-9]*$", re.IGNORECASE)
    """Such a word between a level and what stands before it."""
    _ADDRESS = re.compile(
        rf"(?<![\w:-]){_MAC}{_ALONE}|(?i:(?<=mac\":\")|(?<=mac\": \"))[0-9A-Fa-f]{{12}}(?=\")"
    )
    _BEGINNING = re.compile(rf"(?:(?<=[A-Za-z_])|(?<=[^0-9A-Za-z]-)){_MAC}{_ALONE}")
    """Address that follows a letter or a minus at once, where a line was torn into the next."""
    _GATEWAY = re.compile(r'"(?:rxpk|rxInfo|rx_metadata)":')
    _AGE = re.compile(r"^\s*last seen: (?P<age_ms>[0-9]{1,9}) ms ago")

    def begin(self) -> None:
        """Begin without a partial block."""
        super().begin()
        self._device: str | None = None
        self._idle_ms = "0"
        self._held: dict[str, str] | None = None
        """Power of `iw`, whose age may follow in the next line."""

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """Return the readings of a line, and of the one before if that waited for its age."""
        held, self._held = self._held, None
        age = self._AGE.search(line)
        if age is not None:
            return self.no_reading() if held is None else self._power({**held, **age.groupdict()})
        readings = [] if held is None else self._power(held)
        return readings + super().read_line(line, received_s)

    def read_match(self, fields: Mapping[str, str | None]) -> list[RadioReading]:
        """Return the reading of a match; some lines of a block only describe its device."""
        if "block" in fields or "end" in fields:
            self._device, self._idle_ms = fields.get("block"), "0"
        elif "idle_ms" in fields:
            self._idle_ms = fields["idle_ms"] or "0"
        elif "signal" in fields and self._device is not None:
            self._held = {
                "emitter": self._device,
                "power_dbm": fields["signal"] or "",
                "age_ms": self._idle_ms,
            }
            return []
        else:
            return self._of_device(fields)
        return self.no_reading()

    def passed_over(self, line: str) -> list[RadioReading]:
        """Return the reading of a line of no known form, if nothing in it is ambiguous."""
        if not is_power_only(line):
            return super().passed_over(line) if self._device is None else self.no_reading()
        if self._GATEWAY.search(line):
            return self.refused("packets of a LoRa gateway: lora_gateway reads them")
        addresses = {*self._ADDRESS.findall(line), *self._BEGINNING.findall(line)}
        found = [match for pattern in self._LEVELS for match in pattern.finditer(line)]
        received = [
            each for each in found if not self._LABEL.search(line[: each.start("power_dbm")])
        ]
        levels = {each["power_dbm"] for each in received}
        if len(addresses) > 1 or len(levels) > 1:
            what = "addresses" if len(addresses) > 1 else "powers"
            return self.refused(f"several {what} in a line: read it by `lines`")
        if not levels:
            return self.refused(A_SETTING if found else NO_POWER)
        problem = next(filter(None, map(problem_of_spans, received)), None)
        if problem is not None:
            return self.refused(problem)
        return self._of_device({"emitter": next(iter(addresses), None), "power_dbm": levels.pop()})

    def _of_device(self, fields: Mapping[str, str | None]) -> list[RadioReading]:
        """Return the reading of a device by its address, or by that of its block."""
        emitter = fields.get("emitter") or self._device
        if emitter is None and not self.options.single_emitter:
            return self.refused(NO_ADDRESS)
        power_dbm = fields.get("power_dbm") or fields.get("signal") or ""
        age_ms = fields.get("age_ms") or ""
        return self._power({"emitter": emitter or "", "power_dbm": power_dbm, "age_ms": age_ms})

    def _power(self, texts: Mapping[str, str]) -> list[RadioReading]:
        power_dbm = number(texts["power_dbm"])
        if power_dbm is not None and power_dbm >= 0.0:
            return self.refused("power is not negative: no dBm")
        if (
            power_dbm is not None
            and power_dbm < MIN_DBM
            and len(texts["emitter"]) >= MIN_MAC_LENGTH
        ):
            return self.refused("power is below the noise: nothing measured")
        emitter = texts["emitter"].lower().replace("-", ":")
        return self.read_fields({**texts, "emitter": emitter})


class UavrtDecoder(FrameDecoder):
    """Decoder of pulses: the detectors' datagrams, and lines of the controller's log.

    A datagram has twelve float64: tag, frequency in Hz (0: heartbeat), start in Unix seconds,
    expected next start, SNR in dB, score, three of its group, detection status, confirmation and
    noise. The power is the SNR; `power_offset_db` is the noise in the pulse's bandwidth.
    """

    start = re.compile(rb"\x00{4}|\x00{1,3}\Z|Conf: |C(?:o(?:n(?:f:?)?)?)?\Z")
    _LINE = re.compile(rb"Conf: ([01]) Id: +([0-9]{1,9}) snr: +(-?[0-9]{1,3}\.[0-9]) [^\n]*\n")
    _PULSE = Struct("<12d")
    LONGEST_LINE = 400
    LARGEST_TAG, LARGEST_HZ, LARGEST_S = 2**32, 4e9, 2**33
    MAX_DB = 200.0
    """Highest SNR that a receiver can have."""
    STATUSES, NO_DETECTION = (0.0, 1.0, 2.0, 3.0), 3.0

    def size_at(self, data: bytes, at: int) -> int | None:
        """Return the size of a datagram, or of the rest of a line."""
        if data[at] == 0:
            return self._PULSE.size if len(data) >= at + self._PULSE.size else None
        end = data.find(b"\n", at, at + self.LONGEST_LINE)
        if end < 0:
            return None if len(data) < at + self.LONGEST_LINE else 0
        return end + 1 - at

    def read_frame(self, frame: bytes) -> list[RadioReading] | None:
        """Return the reading of a confirmed pulse; None if this is not a pulse."""
        if frame[0] != 0:
            found = self._LINE.fullmatch(frame)
            if found is None:
                return None
            return self._pulse(int(found[2]), None, float(found[3]), found[1] == b"1")
        tag, hertz, start_s, _, snr_db, *_, status, confirmed, _noise = self._PULSE.unpack(frame)
        in_bounds = (
            tag.is_integer()
            and hertz.is_integer()
            and 0.0 <= tag < self.LARGEST_TAG
            and 0.0 <= hertz <= self.LARGEST_HZ
            and 0.0 <= start_s < self.LARGEST_S
            and status in self.STATUSES
            and confirmed in (0.0, 1.0)
        )
        if not in_bounds:
            return None
        if hertz == 0.0 or status == self.NO_DETECTION:
            return []
        return self._pulse(int(tag), start_s, snr_db, confirmed == 1.0)

    def _pulse(
        self, tag: int, start_s: float | None, snr_db: float, is_confirmed: bool
    ) -> list[RadioReading]:
        if not is_confirmed:
            self.counts.refuse("pulse is not confirmed")
            return []
        if not abs(snr_db) <= self.MAX_DB:
            self.counts.refuse("no SNR")
            return []
        return [RadioReading(tag, device_time_s=start_s, power_dbm=snr_db)]
