"""`sim-link radio`: arguments, lines for people and exit codes."""

from __future__ import annotations

import argparse
import math
import os
import sys
import threading
from pathlib import Path

import msgspec
import numpy as np

from companion.errors import ConfigError
from companion.io.links.specs import LinkSpec, UdpConnect, link_from_url
from companion.io.links.urls import parse_link_url
from companion.io.shell import Clock, Shell
from sim_link.autopilot.scenario import Scenario
from sim_link.fleet.scenario_io import load_scenario
from sim_link.mission.radio import GeodeticEmitter, RadioFollower
from sim_link.world.environment import Emitter

SILENCE_S = 10.0
"""Seconds without a vehicle after which somebody is told."""

DESCRIPTION = """\
Ride on a vehicle that is not simulated here: hear its telemetry and send RADIO_RANGING of an
emitter that is not there, as a payload on board would."""
EPILOG = """\
example, beside PX4 SITL, for a companion started with --ranging udp:127.0.0.1:14600:
  sim-link radio --follow udpin:127.0.0.1:14540 --emitter 47.3981,8.5462 \\
                 --send-to 127.0.0.1:14600"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `radio`."""
    parser.add_argument(
        "--follow", metavar="URL", required=True, help="the link on which the vehicle is heard"
    )
    parser.add_argument(
        "--emitter",
        metavar="LAT,LON[,AMSL]",
        action="append",
        default=[],
        help="where an emitter is, in degrees and metres; repeatable, ids count from 1 "
        "(default: the scenario's, about the vehicle's local origin)",
    )
    parser.add_argument(
        "--send-to", metavar="HOST:PORT", help="where measurements go (default: back to the link)"
    )
    parser.add_argument(
        "--scenario", metavar="FILE", type=Path, help="channel, payload, obstacles and emitters"
    )
    parser.add_argument("--rate", metavar="HZ", type=float, help="measurements per second")
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="of all randomness")
    parser.add_argument("--speed", metavar="X", type=float, default=1.0, help="of the simulator")
    parser.add_argument("--stop-on-eof", action="store_true", help="stop when standard input ends")


def run(arguments: argparse.Namespace) -> int:
    """Follow the vehicle until stopped.

    Returns:
        0 after a stop.

    Raises:
        ConfigError: An argument is wrong.
        LinkError: A link cannot be opened.
    """
    follower, links, clock = _follower(arguments), _links(arguments), _clock(arguments.speed)
    print(f"sim-link: radio on {arguments.follow}", flush=True)
    hints = _Hints(follower, arguments.follow)
    shell = Shell(follower, links, clock, hints.check)
    if arguments.stop_on_eof:
        threading.Thread(target=_stop_at_eof, args=(shell,), daemon=True).start()
    shell.run_blocking()
    print(f"sim-link: radio stopped after {follower.measurements} measurements")
    return 0


def _follower(arguments: argparse.Namespace) -> RadioFollower:
    scenario = Scenario() if arguments.scenario is None else load_scenario(arguments.scenario)
    if arguments.seed < 0:
        raise ConfigError(f"--seed {arguments.seed}: give a number that is not negative")
    payload = scenario.payload
    if arguments.rate is not None:
        if not 0.0 < arguments.rate <= 50.0:
            raise ConfigError(f"--rate {arguments.rate:g}: give 0 to 50")
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
    """The emitter of `LAT,LON[,AMSL]`.

    Raises:
        ConfigError: It is none.
    """
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    is_place = (
        len(values) in (2, 3)
        and all(math.isfinite(value) for value in values)
        and abs(values[0]) <= 89.0
        and abs(values[1]) <= 180.0
    )
    if not is_place:
        raise ConfigError(f"--emitter {text}: give LAT,LON or LAT,LON,AMSL, for example 47.4,8.55")
    altitude_m = values[2] if len(values) == 3 else None
    return GeodeticEmitter(number, values[0], values[1], altitude_m)


def _links(arguments: argparse.Namespace) -> list[LinkSpec]:
    links = [link_from_url(parse_link_url(arguments.follow))]
    if arguments.send_to is not None:
        try:
            url = parse_link_url(f"udpout:{arguments.send_to}")
        except ConfigError:
            problem = f"--send-to {arguments.send_to}: give HOST:PORT, for example 127.0.0.1:14600"
            raise ConfigError(problem) from None
        links.append(UdpConnect(url.host, url.port))
    return links


def _clock(speed: float) -> Clock:
    try:
        return Clock(speed)
    except ValueError:
        raise ConfigError(f"--speed {speed:g}: give a number above 0") from None


def _stop_at_eof(shell: Shell) -> None:
    while os.read(sys.stdin.fileno(), 4096):
        pass
    shell.request_stop()


class _Hints:
    """Says that a vehicle is heard, or that none is."""

    def __init__(self, follower: RadioFollower, link: str) -> None:
        self._follower = follower
        self._link = link
        self._said = ""

    def check(self, now_s: float) -> None:
        """Say what is new."""
        if self._follower.is_following:
            self._say(f"following the vehicle on {self._link}")
        elif now_s > SILENCE_S:
            self._say(f"no autopilot heard on {self._link} yet")

    def _say(self, text: str) -> None:
        if text != self._said:
            self._said = text
            print(f"sim-link: {text}", flush=True)
