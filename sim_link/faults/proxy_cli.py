"""`sim-link proxy`: a bad link between a vehicle and a companion on UDP."""

from __future__ import annotations

import argparse
import signal
from contextlib import suppress
from pathlib import Path

import msgspec
import yaml

from companion.config.loader import load_yaml
from companion.errors import ConfigError
from companion.mav.endpoint import Address
from sim_link.faults.content_kinds import ContentFault
from sim_link.faults.host_kinds import SecurityFault
from sim_link.faults.kinds import Fault
from sim_link.faults.link_kinds import LinkFault
from sim_link.faults.proxy import FaultProxy
from sim_link.faults.schedule import Schedule, fault_from

DESCRIPTION = """
Carry MAVLink between a vehicle and a companion over UDP, with faults: the vehicle sends to
--listen as if that were the companion, and the companion hears the proxy as if it were the vehicle.
"""
EPILOG = """
examples:
  sim-link --send-to 127.0.0.1:14560          the vehicle
  companion --connect udp:127.0.0.1:14550     the companion
  sim-link proxy --fault '{kind: link_loss, share: 0.3}'
  sim-link proxy --faults FILE.yaml           faults: [{kind: link_blackout, start_s: 20}]
"""
TICK_S = 0.2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's own arguments."""
    parser.add_argument("--listen", default="127.0.0.1:14560", metavar="HOST:PORT")
    parser.add_argument("--companion", default="127.0.0.1:14550", metavar="HOST:PORT")
    parser.add_argument("--fault", action="append", default=[], metavar="MAPPING")
    parser.add_argument("--faults", type=Path, metavar="FILE", help="faults as YAML")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--for", dest="for_s", type=float, metavar="SECONDS", help="then end")


def run(arguments: argparse.Namespace) -> int:
    """Carry datagrams until asked to stop.

    Raises:
        ConfigError: A bad address or fault.
        LinkError: The address is taken.
    """
    schedule = _schedule(arguments.fault, arguments.faults)
    listen, companion = address_of(arguments.listen), address_of(arguments.companion)
    if arguments.seed < 0 or (arguments.for_s is not None and arguments.for_s <= 0.0):
        raise ConfigError("--seed must not be negative, --for must be above 0")
    with FaultProxy(listen, companion, schedule, arguments.seed) as proxy:
        host, port = proxy.vehicle_side
        print(f"proxy: vehicle to {host}:{port}, companion {arguments.companion}", flush=True)
        with suppress(KeyboardInterrupt):
            _carry(proxy, arguments.for_s)
        print(f"proxy: {proxy.counters}", flush=True)
    return 0


def _carry(proxy: FaultProxy, for_s: float | None) -> None:
    before = signal.signal(signal.SIGTERM, _interrupt)
    try:
        if for_s is not None:
            proxy.run(for_s)
            return
        while True:
            proxy.run(TICK_S)
    finally:
        signal.signal(signal.SIGTERM, before)


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def _schedule(texts: list[str], path: Path | None) -> Schedule:
    faults: list[Fault] = [] if path is None else list(load_yaml(path, Schedule).faults)
    for text in texts:
        try:
            faults.append(fault_from(yaml.safe_load(text)))
        except (yaml.YAMLError, msgspec.ValidationError) as error:
            problem = " ".join(str(error).split())
            raise ConfigError(f"--fault {text!r}: {problem}") from None
    for fault in faults:
        if not isinstance(fault, LinkFault | ContentFault | SecurityFault):
            kind = fault.__struct_config__.tag
            raise ConfigError(f"{kind} happens to a vehicle or a process, not to a link")
    return Schedule(faults=tuple(faults))


def address_of(text: str) -> Address:
    """Host and port.

    Raises:
        ConfigError: It is no HOST:PORT.
    """
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65_535:
        raise ConfigError(f"{text!r} is no HOST:PORT")
    return host, int(port)
