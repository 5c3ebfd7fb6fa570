"""Simulated ranging radio on a vehicle of another simulator, and the command `sim-link radio`.

Theory of operation. The radio measures when LOCAL_POSITION_NED arrives and a measurement is due, at
the frame's time and position: so it uses the autopilot's clock, and no link delay shifts a
measurement. It requests the stream and the origin of the local frame while they are missing, and
ATTITUDE if its antenna tilts with the vehicle. Its frames have the vehicle's system id, like those
of a payload. A lagging measurement is stamped and sent with the first frame after its lag.

With an emulator it prints the output of a real radio on a separate link, and the vehicle hears only
the requests. The same seed gives the same measurements.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from companion.arguments import number_in
from companion.domain import PositionEnu, RangingMeasurement
from companion.errors import ConfigError
from companion.geometry.coordinates import (
    LocalOrigin,
    Projection,
    bearing_ned_from_enu,
    enu_from_ned,
    wrap_pi,
)
from companion.io.links.transports import Transport, UdpConnect, parse_transport, udp_address
from companion.io.shell import Clock, Shell
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink, message_from_ranging
from companion.mav.endpoint import Address, Chunk, OneShotEndpoint
from companion.mav.flight_modes import autopilot_of
from sim_link.autopilot.other_senders import PAYLOAD_ID, payload_heartbeat
from sim_link.autopilot.scenario import PayloadParams, Scenario
from sim_link.emulators.catalogue import EMULATORS, check_emitters, kind_of, make_emulator
from sim_link.emulators.emulator import Answer, Emulator, Round
from sim_link.fleet import load_scenario
from sim_link.lab.radio_outlets import is_stdout, parse_outlet
from sim_link.world.environment import ChannelParams, Emitter, EmitterParams, Environment
from sim_link.world.field_radio import FieldRadio
from sim_link.world.point_mass import LEVEL, EulerAngles
from sim_link.world.radio_channel import AntennaModelParams

FOLLOW, SEND = 0, 1
"""Links: the vehicle's, and the one for measurements if separate."""
HEARTBEAT_S = 1.0
ASK_AGAIN_S = 2.0
POSITION_INTERVAL_US = 50_000.0


@dataclass(frozen=True, slots=True)
class GeodeticEmitter:
    """An emitter by its position on the Earth."""

    emitter_id: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None
    """Altitude above mean sea level; None: that of the local origin."""

    def local(self, origin: LocalOrigin) -> Emitter:
        """Return the same in the local frame."""
        altitude_m = origin.altitude_m if self.altitude_m is None else self.altitude_m
        position = (self.latitude_deg, self.longitude_deg, altitude_m)
        east, north, up = origin.enu_from_geodetic(*position)
        height_m = 0.0 if self.altitude_m is None else up
        params = EmitterParams(
            emitter_id=self.emitter_id, position_enu_m=(east, north), height_m=height_m
        )
        return Emitter(params)


def seen_from_nose(heard: RangingMeasurement, yaw_rad: float) -> RangingMeasurement:
    """Return the measurement with its bearing from north as one from the nose."""
    if heard.bearing_enu_rad is None:
        return heard
    body_rad = wrap_pi(bearing_ned_from_enu(heard.bearing_enu_rad) - yaw_rad)
    return replace(heard, bearing_enu_rad=None, bearing_body_rad=body_rad)


class RadioFollower(OneShotEndpoint):
    """Radio carried by the vehicle; emitters with a position on the Earth wait for the origin.

    With a separate link measurements go to link 1 instead of back to the vehicle's.
    """

    def __init__(
        self,
        params: PayloadParams,
        channel: ChannelParams,
        emitters: Sequence[Emitter | GeodeticEmitter],
        rng: np.random.Generator,
        environment: Environment | None = None,
        *,
        has_own_link: bool = False,
        emulator: Emulator | None = None,
    ) -> None:
        super().__init__(None, HEARTBEAT_S)
        self._params = params
        self._emulator = emulator
        self._radio = FieldRadio(channel, rng, environment, params.antenna, params.measures)
        self._attitude = LEVEL
        self._attitude_heard_s = -math.inf
        self._late: deque[Round] = deque()
        self._wanted = tuple(emitters)
        self._emitters: tuple[Emitter, ...] = ()
        self._set_emitters([each for each in emitters if isinstance(each, Emitter)])
        self._link = SEND if has_own_link or emulator is not None else FOLLOW
        self._codec = MavCodec(1, PAYLOAD_ID)
        self._reader = MavCodec(0, 0)
        self._peer: Address | None = None
        self._projection = Projection.ELLIPSOID
        self._system_id: int | None = None
        self._ground_up_m = 0.0
        self._position_heard_s = -math.inf
        self._measured_at_s = -math.inf
        self._asked_s = -math.inf
        self._has_booted = False
        self.measurements = 0

    @property
    def is_following(self) -> bool:
        """True if a vehicle is heard."""
        return self._system_id is not None

    @property
    def needs_origin(self) -> bool:
        """True if emitters wait for the origin of the local frame."""
        return len(self._emitters) < len(self._wanted)

    @property
    def emitter_ids(self) -> tuple[int, ...]:
        """Ids of all emitters that are present."""
        return tuple(emitter.emitter_id for emitter in self._wanted)

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Take the vehicle's position from its telemetry."""
        if chunk.link != FOLLOW:
            if self._emulator is not None:
                self._print(self._emulator.hear(chunk.data))
            return
        for message in self._reader.decode(chunk.data, is_datagram=chunk.is_datagram):
            if self._is_the_vehicle(message):
                self._peer = chunk.peer
                self._take(message, now_s)

    def _is_the_vehicle(self, message: Message) -> bool:
        if message.get_srcComponent() != mavlink.MAV_COMP_ID_AUTOPILOT1:
            return False
        match message:
            case mavlink.MAVLink_heartbeat_message() if self._system_id is None:
                autopilot = autopilot_of(message)
                if autopilot is not None:
                    self._projection = autopilot.projection
                    self._system_id = self._codec.system_id = message.get_srcSystem()
        return message.get_srcSystem() == self._system_id

    def _take(self, message: Message, now_s: float) -> None:
        match message:
            case mavlink.MAVLink_local_position_ned_message():
                self._position_heard_s = now_s
                position = enu_from_ned((message.x, message.y, message.z))
                if all(math.isfinite(value) for value in position):
                    stamp_s = message.time_boot_ms / 1000.0
                    self._measure(position, stamp_s)
                    while self._late and self._late[0].sent_at_s <= stamp_s:
                        due = self._late.popleft()
                        if self._emulator is not None:
                            self._print(self._emulator.encode(due))
                            continue
                        for answer in due.heard:
                            assert answer.heard is not None
                            stamp_us = round(1e6 * due.sent_at_s)
                            self._send(message_from_ranging(answer.heard, stamp_us), self._link)
            case mavlink.MAVLink_attitude_message():
                self._attitude_heard_s = now_s
                self._attitude = EulerAngles(message.roll, message.pitch, message.yaw)
            case mavlink.MAVLink_home_position_message():
                if math.isfinite(message.z):
                    self._ground_up_m = -message.z
            case mavlink.MAVLink_gps_global_origin_message() if self.needs_origin:
                origin = LocalOrigin(
                    message.latitude / 1e7,
                    message.longitude / 1e7,
                    message.altitude / 1000.0,
                    self._projection,
                )
                wanted = self._wanted
                self._set_emitters(
                    [e if isinstance(e, Emitter) else e.local(origin) for e in wanted]
                )

    def _set_emitters(self, emitters: Sequence[Emitter]) -> None:
        self._emitters = tuple(emitters)
        for emitter in self._emitters:
            self._radio.prepare(emitter)

    def _measure(self, position: PositionEnu, stamp_s: float) -> None:
        period_s = 1.0 / self._params.rate_hz
        if stamp_s < self._measured_at_s:  # the autopilot restarted
            self._measured_at_s = -math.inf
            self._late.clear()
        if stamp_s - self._measured_at_s < period_s - 1e-3:
            return
        late_s = stamp_s - self._measured_at_s - period_s
        # steady on average though positions come when they come
        self._measured_at_s = stamp_s - late_s if 0.0 < late_s < period_s else stamp_s
        answers = tuple(self._asked(emitter, position, stamp_s) for emitter in self._emitters)
        self._late.append(Round(stamp_s + self._params.lag_s, answers))

    def _asked(self, emitter: Emitter, position: PositionEnu, stamp_s: float) -> Answer:
        """Answer of an emitter; for an emulator, a bearing from north becomes one from the nose."""
        heard = None
        is_high = position[2] - self._ground_up_m >= self._params.min_altitude_m
        if is_high and emitter.slant_range_m(position) <= self._params.max_range_m:
            heard = self._radio.hear(emitter, position, stamp_s, self._attitude)
        self.measurements += heard is not None
        if heard is None or self._emulator is None or self._emulator.reports_north:
            return Answer(emitter.emitter_id, heard)
        return Answer(emitter.emitter_id, seen_from_nose(heard, self._attitude.yaw_rad))

    def _print(self, data: bytes) -> None:
        if data:
            self._output.append(Chunk(SEND, data))

    def handle_timer(self, now_s: float) -> None:
        """Send the heartbeat and missing requests."""
        super().handle_timer(now_s)
        if self._emulator is not None and not self._has_booted:
            self._has_booted = True
            self._print(self._emulator.banner)
        if self._system_id is None:
            return
        if self._emulator is None:
            self._send(payload_heartbeat(), self._link)
        if now_s - self._asked_s < ASK_AGAIN_S:
            return
        self._asked_s = now_s
        interval, request = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAV_CMD_REQUEST_MESSAGE
        if now_s - self._position_heard_s > ASK_AGAIN_S:
            self._ask(interval, mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, POSITION_INTERVAL_US)
        is_turned = self._params.antenna.kind != "ideal" or self._emulator is not None
        if is_turned and now_s - self._attitude_heard_s > ASK_AGAIN_S:
            self._ask(interval, mavlink.MAVLINK_MSG_ID_ATTITUDE, POSITION_INTERVAL_US)
        if self.needs_origin:
            self._ask(request, mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)

    def _ask(self, command: int, number: int, interval_us: float = 0.0) -> None:
        target = (self._system_id or 1, mavlink.MAV_COMP_ID_AUTOPILOT1)
        params = (float(number), interval_us, *[0.0] * 5)
        self._send(mavlink.MAVLink_command_long_message(*target, command, 0, *params), FOLLOW)

    def _send(self, message: Message, link: int) -> None:
        peer = self._peer if link == FOLLOW else None
        self._output.append(Chunk(link, self._codec.encode(message), peer))


MAX_HZ = 50.0
"""Largest rate of positions, Hz."""
SILENCE_S = 10.0
"""Seconds without a vehicle after which a warning is printed."""

DESCRIPTION = """\
Ride on a vehicle that is not simulated here: hear its telemetry and send RADIO_RANGING of an
emitter that is not there, as a payload on board would; or print what a real radio would."""
EPILOG = """\
examples, for a companion started with --ranging udp:127.0.0.1:14600, on free ports:
  sim-link radio --follow udpin:127.0.0.1:14030 --send-to 127.0.0.1:14600   beside PX4 SITL
  sim-link radio --follow tcp:127.0.0.1:5763 --send-to 127.0.0.1:14600      beside ArduPilot SITL
and for one that reads a radio of its own:
  sim-link radio --follow tcp:127.0.0.1:14030 --as nlink_aoa --to pty:/tmp/uwb
  companion ... --radio nlink@serial:/tmp/uwb:921600"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `radio`."""
    add = parser.add_argument
    add("--follow", metavar="URL", required=True, help="the link on which the vehicle is heard")
    add(
        "--emitter",
        metavar="LAT,LON[,AMSL]",
        action="append",
        default=[],
        help="position of an emitter, degrees and metres; repeatable, ids count from 1 "
        "(default: the scenario's, about the vehicle's local origin)",
    )
    add("--send-to", metavar="HOST:PORT", help="target of measurements (default: back to the link)")
    add("--scenario", metavar="FILE", type=Path, help="channel, payload, obstacles and emitters")
    add(
        "--rate",
        metavar="HZ",
        type=number_in(0.0, 50.0, is_open=True),
        help="measurements per second",
    )
    add("--seed", metavar="N", type=number_in(0, kind=int), default=0, help="seed of all draws")
    names = ", ".join(sorted(EMULATORS))
    add("--as", dest="radio", metavar="NAME", help=f"print as this radio does: {names}")
    where = "output of the radio's bytes: pty:PATH, serial:DEVICE:BAUD, udpout:HOST:PORT, "
    where += "tcpin:HOST:PORT, stdout:, http:HOST:PORT for a radio that is polled, or ws:HOST:PORT"
    add("--to", metavar="URL", help=where)
    clock = "reading of the emulated radio's clock at the vehicle's second 0 (default: by the seed)"
    add("--clock", metavar="S", type=number_in(0.0, 1e9), help=clock)
    above_zero = number_in(0.0, 1000.0, is_open=True)
    add("--speed", metavar="X", type=above_zero, default=1.0, help="speed of the simulator")
    add("--stop-on-eof", action="store_true", help="stop when standard input ends")


def run(arguments: argparse.Namespace) -> int:
    """Follow the vehicle until stopped; raise ConfigError or LinkError for bad input."""
    _check_options(arguments)
    follower, links = _follower(arguments), _links(arguments)
    say = _speaker(arguments)
    say(f"radio on {arguments.follow}")
    for line in _names_on_wire(arguments, follower.emitter_ids):
        say(line)
    hints = _hints(follower, arguments.follow, say)
    shell = Shell(follower, links, Clock(arguments.speed), hints)
    if arguments.stop_on_eof:
        threading.Thread(target=_stop_at_eof, args=(shell,), daemon=True).start()
    shell.run_blocking()
    say(f"radio stopped after {follower.measurements} measurements")
    return 0


def _check_options(arguments: argparse.Namespace) -> None:
    """Check options of emulated radios and of RADIO_RANGING, some of which exclude each other."""
    if arguments.radio is None:
        for name, value in (("--to", arguments.to), ("--clock", arguments.clock)):
            if value is not None:
                raise ConfigError(f"{name} {value}: which radio is it? give --as NAME as well")
        return
    kind_of(arguments.radio)
    if arguments.to is None:
        raise ConfigError(f"--as {arguments.radio}: where to? give --to URL as well")
    if arguments.send_to is not None:
        raise ConfigError("--send-to is for RADIO_RANGING; an emulated radio prints --to a URL")


def _speaker(arguments: argparse.Namespace) -> Callable[[str], None]:
    """Return a function that prints texts, apart from the radio's output."""
    is_taken = arguments.to is not None and is_stdout(arguments.to)
    stream = sys.stderr if is_taken else sys.stdout
    return lambda text: print(f"sim-link: {text}", file=stream, flush=True)


def _names_on_wire(arguments: argparse.Namespace, emitter_ids: Sequence[int]) -> list[str]:
    if arguments.radio is None:
        return []
    kind = kind_of(arguments.radio)
    names = {emitter_id: kind.name_on_wire(emitter_id) for emitter_id in emitter_ids}
    said = ", ".join(f"emitter {i} is {name or 'not named'}" for i, name in names.items())
    return [f"{kind.title} to {arguments.to}; {said}"]


def _follower(arguments: argparse.Namespace) -> RadioFollower:
    kind = None if arguments.radio is None else kind_of(arguments.radio)
    scenario = Scenario() if arguments.scenario is None else load_scenario(arguments.scenario)
    payload = scenario.payload
    if kind is not None and arguments.scenario is None:
        payload = PayloadParams(
            rate_hz=min(kind.rate_hz, MAX_HZ),
            measures=kind.measures,
            antenna=AntennaModelParams(kind=kind.antenna),
        )
    if arguments.rate is not None:
        payload = msgspec.structs.replace(payload, rate_hz=arguments.rate)
    emitters: list[Emitter | GeodeticEmitter] = [
        parse_emitter(text, number) for number, text in enumerate(arguments.emitter, 1)
    ]
    if not emitters:
        emitters = [Emitter(each) for each in (scenario.emitter, *scenario.emitters)]
    if kind is not None:
        check_emitters(kind, [each.emitter_id for each in emitters])
    return RadioFollower(
        payload,
        scenario.channel,
        emitters,
        np.random.default_rng(arguments.seed),
        scenario.environment,
        has_own_link=arguments.send_to is not None,
        emulator=None
        if kind is None
        else make_emulator(kind.name, arguments.seed, arguments.clock),
    )


def parse_emitter(text: str, number: int) -> GeodeticEmitter:
    """Return the emitter of `LAT,LON[,AMSL]`; raise `ConfigError` if malformed."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    is_valid = len(values) in (2, 3) and all(map(math.isfinite, values))
    if not is_valid or abs(values[0]) > 89.0 or abs(values[1]) > 180.0:
        raise ConfigError(f"--emitter {text}: give LAT,LON or LAT,LON,AMSL, for example 47.4,8.55")
    altitude_m = values[2] if len(values) == 3 else None
    return GeodeticEmitter(number, values[0], values[1], altitude_m)


def _links(arguments: argparse.Namespace) -> list[Transport]:
    links = [parse_transport(arguments.follow)]
    if arguments.send_to is not None:
        links.append(UdpConnect(*udp_address("--send-to", arguments.send_to)))
    if arguments.radio is not None:
        links.append(parse_outlet(arguments.to, kind_of(arguments.radio)))
    return links


def _stop_at_eof(shell: Shell) -> None:
    while os.read(sys.stdin.fileno(), 4096):
        pass
    shell.request_stop()


def _hints(
    follower: RadioFollower, link: str, say: Callable[[str], None]
) -> Callable[[float], None]:
    """Return a function that reports once if a vehicle is heard, or if none is."""
    said = ""

    def check(now_s: float) -> None:
        nonlocal said
        text = said
        if follower.is_following:
            text = f"following the vehicle on {link}"
        elif now_s > SILENCE_S:
            text = f"no autopilot heard on {link} yet"
        if text != said:
            said = text
            say(text)

    return check
