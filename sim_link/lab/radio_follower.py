"""`sim-link radio`: a ranging radio that rides on a vehicle which is not simulated here.

Theory of operation. The radio measures when LOCAL_POSITION_NED arrives and a measurement is due, at
the frame's own time and place: so its stamps are the autopilot's, and no delay of the link shifts
one. It asks for the stream and for the origin of the local frame while they are missing, and for
ATTITUDE where its antenna feels how the vehicle leans. Its frames bear the vehicle's system id, as
those of a payload on board would. What lags is stamped and sent with the first frame after its lag.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from companion.arguments import number_in
from companion.domain import PositionEnu, RangingMeasurement
from companion.errors import ConfigError
from companion.geometry.coordinates import LocalOrigin, Projection, enu_from_ned
from companion.io.links.transports import Transport, UdpConnect, parse_transport, udp_address
from companion.io.shell import Clock, Shell
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Address, Chunk
from companion.mav.flight_modes import autopilot_of
from companion.mav.ranging import message_from_ranging
from sim_link.autopilot.radio_payload import COMPONENT_ID, payload_heartbeat
from sim_link.autopilot.scenario import PayloadParams, Scenario
from sim_link.fleet.scenario_io import load_scenario
from sim_link.world.attitude import LEVEL, Attitude
from sim_link.world.environment import ChannelParams, Emitter, EmitterParams, Environment
from sim_link.world.field_radio import FieldRadio

FOLLOW, SEND = 0, 1
"""Links: where the vehicle is heard, and where measurements go to if that is another one."""
HEARTBEAT_S = 1.0
ASK_AGAIN_S = 2.0
POSITION_INTERVAL_US = 50_000.0


@dataclass(frozen=True, slots=True)
class GeodeticEmitter:
    """An emitter by its place on Earth."""

    emitter_id: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None
    """Above mean sea level; None: at the height of the local origin."""

    def local(self, origin: LocalOrigin) -> Emitter:
        """The same in the local frame."""
        altitude_m = origin.altitude_m if self.altitude_m is None else self.altitude_m
        place = (self.latitude_deg, self.longitude_deg, altitude_m)
        east, north, up = origin.enu_from_geodetic(*place)
        height_m = 0.0 if self.altitude_m is None else up
        params = EmitterParams(
            emitter_id=self.emitter_id, position_enu_m=(east, north), height_m=height_m
        )
        return Emitter(params)


class RadioFollower:
    """A `companion.mav.endpoint.Endpoint`; emitters with a place on Earth wait for the origin.

    With a link of its own measurements go to link 1 instead of back to the vehicle's.
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
    ) -> None:
        self._params = params
        self._radio = FieldRadio(channel, rng, environment, params.antenna, params.measures)
        self._attitude = LEVEL
        self._attitude_heard_s = -math.inf
        self._late: deque[tuple[float, RangingMeasurement]] = deque()
        """What is still to be told, and when."""
        self._wanted = tuple(emitters)
        self._emitters: tuple[Emitter, ...] = ()
        self._place_emitters([each for each in emitters if isinstance(each, Emitter)])
        self._link = SEND if has_own_link else FOLLOW
        self._codec = MavCodec(1, COMPONENT_ID)
        self._reader = MavCodec(0, 0)
        self._peer: Address | None = None
        self._projection = Projection.ELLIPSOID
        self._system_id: int | None = None
        self._ground_up_m = 0.0
        self._position_heard_s = -math.inf
        self._measured_at_s = -math.inf
        self._next_s = 0.0
        self._asked_s = -math.inf
        self._is_finished = False
        self._output: list[Chunk] = []
        self.measurements = 0

    @property
    def is_following(self) -> bool:
        """Whether a vehicle is heard."""
        return self._system_id is not None

    @property
    def needs_origin(self) -> bool:
        """Whether emitters wait for the origin of the local frame."""
        return len(self._emitters) < len(self._wanted)

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Hear the vehicle."""
        if chunk.link != FOLLOW:
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
                place = enu_from_ned((message.x, message.y, message.z))
                if all(math.isfinite(value) for value in place):
                    stamp_s = message.time_boot_ms / 1000.0
                    self._measure(place, stamp_s)
                    self._tell_late(stamp_s)
            case mavlink.MAVLink_attitude_message():
                self._attitude_heard_s = now_s
                self._attitude = Attitude(message.roll, message.pitch, message.yaw)
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
                self._place_emitters(
                    [e if isinstance(e, Emitter) else e.local(origin) for e in wanted]
                )

    def _place_emitters(self, emitters: Sequence[Emitter]) -> None:
        self._emitters = tuple(emitters)
        for emitter in self._emitters:
            self._radio.prepare(emitter)

    def _measure(self, place: PositionEnu, stamp_s: float) -> None:
        period_s = 1.0 / self._params.rate_hz
        if stamp_s < self._measured_at_s:  # the autopilot restarted
            self._measured_at_s = -math.inf
            self._late.clear()
        if stamp_s - self._measured_at_s < period_s - 1e-3:
            return
        late_s = stamp_s - self._measured_at_s - period_s
        # steady on average though positions come when they come
        self._measured_at_s = stamp_s - late_s if 0.0 < late_s < period_s else stamp_s
        if place[2] - self._ground_up_m < self._params.min_altitude_m:
            return
        for emitter in self._emitters:
            if emitter.slant_range_m(place) <= self._params.max_range_m:
                measurement = self._radio.hear(emitter, place, stamp_s, self._attitude)
                if measurement is not None:
                    self._late.append((stamp_s + self._params.lag_s, measurement))

    def _tell_late(self, stamp_s: float) -> None:
        while self._late and self._late[0][0] <= stamp_s:
            told_s, measurement = self._late.popleft()
            self._send(message_from_ranging(measurement, round(1e6 * told_s)), self._link)
            self.measurements += 1

    def handle_timer(self, now_s: float) -> None:
        """Heartbeat, and ask for what is missing."""
        self._next_s = now_s + HEARTBEAT_S
        if self._system_id is None:
            return
        self._send(payload_heartbeat(), self._link)
        if now_s - self._asked_s < ASK_AGAIN_S:
            return
        self._asked_s = now_s
        if now_s - self._position_heard_s > ASK_AGAIN_S:
            number = float(mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
            self._ask(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, number, POSITION_INTERVAL_US)
        is_turned = self._params.antenna.kind != "ideal"
        if is_turned and now_s - self._attitude_heard_s > ASK_AGAIN_S:
            number = float(mavlink.MAVLINK_MSG_ID_ATTITUDE)
            self._ask(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, number, POSITION_INTERVAL_US)
        if self.needs_origin:
            number = float(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)
            self._ask(mavlink.MAV_CMD_REQUEST_MESSAGE, number, 0.0)

    def _ask(self, command: int, param1: float, param2: float) -> None:
        target = (self._system_id or 1, mavlink.MAV_COMP_ID_AUTOPILOT1)
        rest = [0.0] * 5
        self._send(
            mavlink.MAVLink_command_long_message(*target, command, 0, param1, param2, *rest), FOLLOW
        )

    def _send(self, message: Message, link: int) -> None:
        peer = self._peer if link == FOLLOW else None
        self._output.append(Chunk(link, self._codec.encode(message), peer))

    def next_timer_s(self) -> float:
        """When the next heartbeat is due."""
        return self._next_s

    def take_output(self) -> list[Chunk]:
        """What is to be sent; taken once."""
        output, self._output = self._output, []
        return output

    def request_stop(self, now_s: float) -> None:  # noqa: ARG002  the protocol gives the time
        """End at once."""
        self._is_finished = True

    @property
    def is_finished(self) -> bool:
        """Whether it was asked to end."""
        return self._is_finished


SILENCE_S = 10.0
"""Seconds without a vehicle after which somebody is told."""

DESCRIPTION = """\
Ride on a vehicle that is not simulated here: hear its telemetry and send RADIO_RANGING of an
emitter that is not there, as a payload on board would."""
EPILOG = """\
examples, for a companion started with --ranging udp:127.0.0.1:14600, on ports that nobody else has:
  sim-link radio --follow udpin:127.0.0.1:14030 --send-to 127.0.0.1:14600   beside PX4 SITL
  sim-link radio --follow tcp:127.0.0.1:5763 --send-to 127.0.0.1:14600      beside ArduPilot SITL"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `radio`."""
    add = parser.add_argument
    add("--follow", metavar="URL", required=True, help="the link on which the vehicle is heard")
    add(
        "--emitter",
        metavar="LAT,LON[,AMSL]",
        action="append",
        default=[],
        help="where an emitter is, in degrees and metres; repeatable, ids count from 1 "
        "(default: the scenario's, about the vehicle's local origin)",
    )
    add("--send-to", metavar="HOST:PORT", help="where measurements go (default: back to the link)")
    add("--scenario", metavar="FILE", type=Path, help="channel, payload, obstacles and emitters")
    add(
        "--rate",
        metavar="HZ",
        type=number_in(0.0, 50.0, is_open=True),
        help="measurements per second",
    )
    add("--seed", metavar="N", type=number_in(0, kind=int), default=0, help="of all randomness")
    above_zero = number_in(0.0, 1000.0, is_open=True)
    add("--speed", metavar="X", type=above_zero, default=1.0, help="of the simulator")
    add("--stop-on-eof", action="store_true", help="stop when standard input ends")


def run(arguments: argparse.Namespace) -> int:
    """Follow the vehicle until stopped; a ConfigError or LinkError for what is bad input."""
    follower, links, clock = _follower(arguments), _links(arguments), Clock(arguments.speed)
    print(f"sim-link: radio on {arguments.follow}", flush=True)
    shell = Shell(follower, links, clock, _hints(follower, arguments.follow))
    if arguments.stop_on_eof:
        threading.Thread(target=_stop_at_eof, args=(shell,), daemon=True).start()
    shell.run_blocking()
    print(f"sim-link: radio stopped after {follower.measurements} measurements")
    return 0


def _follower(arguments: argparse.Namespace) -> RadioFollower:
    scenario = Scenario() if arguments.scenario is None else load_scenario(arguments.scenario)
    payload = scenario.payload
    if arguments.rate is not None:
        payload = msgspec.structs.replace(payload, rate_hz=arguments.rate)
    emitters: list[Emitter | GeodeticEmitter] = [
        parse_emitter(text, number) for number, text in enumerate(arguments.emitter, 1)
    ]
    if not emitters:
        emitters = [Emitter(each) for each in (scenario.emitter, *scenario.emitters)]
    return RadioFollower(
        payload,
        scenario.channel,
        emitters,
        np.random.default_rng(arguments.seed),
        scenario.environment,
        has_own_link=arguments.send_to is not None,
    )


def parse_emitter(text: str, number: int) -> GeodeticEmitter:
    """The emitter of `LAT,LON[,AMSL]`; `ConfigError`: it is none."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    is_place = len(values) in (2, 3) and all(map(math.isfinite, values))
    if not is_place or abs(values[0]) > 89.0 or abs(values[1]) > 180.0:
        raise ConfigError(f"--emitter {text}: give LAT,LON or LAT,LON,AMSL, for example 47.4,8.55")
    altitude_m = values[2] if len(values) == 3 else None
    return GeodeticEmitter(number, values[0], values[1], altitude_m)


def _links(arguments: argparse.Namespace) -> list[Transport]:
    links = [parse_transport(arguments.follow)]
    if arguments.send_to is not None:
        links.append(UdpConnect(*udp_address("--send-to", arguments.send_to)))
    return links


def _stop_at_eof(shell: Shell) -> None:
    while os.read(sys.stdin.fileno(), 4096):
        pass
    shell.request_stop()


def _hints(follower: RadioFollower, link: str) -> Callable[[float], None]:
    """Says that a vehicle is heard, or that none is, once each."""
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
            print(f"sim-link: {text}", flush=True)

    return check
