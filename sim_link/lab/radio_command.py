"""`sim-link radio`: arguments, lines for people, and who is asked to carry what."""

from __future__ import annotations

import argparse
import math
import os
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np

from companion.arguments import number_in
from companion.errors import ConfigError
from companion.io.links.transports import Transport, UdpConnect, parse_transport, udp_address
from companion.io.shell import Clock, Shell
from sim_link.autopilot.scenario import PayloadParams, Scenario
from sim_link.emulators.catalogue import EMULATORS, check_emitters, kind_of, make_emulator
from sim_link.fleet.vehicles import load_scenario
from sim_link.lab.radio_follower import GeodeticEmitter, RadioFollower
from sim_link.lab.radio_outlets import is_stdout, parse_outlet
from sim_link.world.environment import Emitter
from sim_link.world.radio_channel import AntennaModelParams

MOST_HZ = 50.0
"""Positions come no faster."""
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
    names = ", ".join(sorted(EMULATORS))
    add("--as", dest="radio", metavar="NAME", help=f"print as this radio does: {names}")
    where = "where the radio's bytes go: pty:PATH, serial:DEVICE:BAUD, udpout:HOST:PORT, "
    where += "tcpin:HOST:PORT, stdout:, http:HOST:PORT for a radio that is polled, or ws:HOST:PORT"
    add("--to", metavar="URL", help=where)
    clock = "what the emulated radio's clock shows at the vehicle's second 0 (default: by the seed)"
    add("--clock", metavar="S", type=number_in(0.0, 1e9), help=clock)
    above_zero = number_in(0.0, 1000.0, is_open=True)
    add("--speed", metavar="X", type=above_zero, default=1.0, help="of the simulator")
    add("--stop-on-eof", action="store_true", help="stop when standard input ends")


def run(arguments: argparse.Namespace) -> int:
    """Follow the vehicle until stopped; a ConfigError or LinkError for what is bad input."""
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
            rate_hz=min(kind.rate_hz, MOST_HZ),
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
    """Return the emitter of `LAT,LON[,AMSL]`; `ConfigError`: it is none."""
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
    """Return a function that reports once that a vehicle is heard, or that none is."""
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
