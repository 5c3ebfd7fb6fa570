"""The `companion-conformance` command: its rules, the real link, arguments and exit codes.

The links of `companion.io` run on an event loop; a probe reads like a script. So a loop of our own
runs only while a probe waits.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

from companion import __version__
from companion.errors import CompanionError, ConfigError
from companion.io.files import write_json_atomic
from companion.io.links.link import Link
from companion.io.links.transports import (
    SerialPort,
    TcpClient,
    Transport,
    UdpBind,
    UdpConnect,
    make_link,
    parse_transport,
)
from companion.io.state.signing_keys import load_signing_key
from companion.mav.endpoint import Address, Chunk
from sim_link.fleet.console import ComplaintParser
from sim_link.lab.conformance.companion_identity_rules import IdentityRules, RequestRules
from sim_link.lab.conformance.companion_setpoint_rules import SetpointRules
from sim_link.lab.conformance.puppet import CompanionProbe
from sim_link.lab.conformance.rules import (
    Effect,
    Flavour,
    NotApplicable,
    Role,
    Rule,
    RuleOutcome,
    RuleVerdict,
    line,
    listing,
    record,
    run_rules,
    select,
    summary,
)
from sim_link.lab.conformance.vehicle_probe import VehicleProbe
from sim_link.lab.conformance.vehicle_rules.command_rules import ArmingRules, CommandRules
from sim_link.lab.conformance.vehicle_rules.connection_rules import HeartbeatRules, RoutingRules
from sim_link.lab.conformance.vehicle_rules.flight_rules import FailsafeRules, FlightRules
from sim_link.lab.conformance.vehicle_rules.frame_rules import FrameRules
from sim_link.lab.conformance.vehicle_rules.mission_rules import MissionRules
from sim_link.lab.conformance.vehicle_rules.parameter_rules import ParameterRules
from sim_link.lab.conformance.vehicle_rules.setpoint_mode_rules import (
    GuidedRules,
    OffboardLossRules,
)
from sim_link.lab.conformance.vehicle_rules.setpoint_rules import OffboardRules
from sim_link.lab.conformance.vehicle_rules.signing_rules import ClockRules, SigningRules
from sim_link.lab.conformance.vehicle_rules.telemetry_rules import StreamRules, TelemetryRules
from sim_link.lab.conformance.vehicle_rules.upload_rules import (
    FenceRules,
    PlanResultRules,
    UploadRules,
)

BOOKS = (
    FrameRules.book,
    HeartbeatRules.book,
    RoutingRules.book,
    SigningRules.book,
    CommandRules.book,
    ClockRules.book,
    StreamRules.book,
    TelemetryRules.book,
    ParameterRules.book,
    MissionRules.book,
    UploadRules.book,
    PlanResultRules.book,
    FenceRules.book,
    ArmingRules.book,
    FlightRules.book,
    OffboardRules.book,
    OffboardLossRules.book,
    GuidedRules.book,
    FailsafeRules.book,
    IdentityRules.book,
    RequestRules.book,
    SetpointRules.book,
)


def all_rules() -> list[Rule]:
    """Every rule of every role."""
    return [rule for book in BOOKS for rule in book.rules]


CONNECT_GRACE_S = 0.3
"""How long a TCP connection or serial device may take before the first byte is sent."""


class WireLink:
    """One open connection; a `ProbeLink`."""

    def __init__(self, spec: Transport, loop: asyncio.AbstractEventLoop) -> None:
        self._spec = spec
        self._loop = loop
        self._arrived: list[bytes] = []
        self._peer: Address | None = None
        self._wake = asyncio.Event()
        self._others: list[WireLink] = []
        self._link: Link = make_link(spec, 0, self._receive)

    def open(self) -> None:
        """Bind or connect; `LinkError`: it cannot be opened."""
        self._loop.run_until_complete(self._link.open())
        if isinstance(self._spec, TcpClient | SerialPort):
            self._loop.run_until_complete(asyncio.sleep(CONNECT_GRACE_S))

    @property
    def now_s(self) -> float:
        """The wall clock, monotonic."""
        return time.monotonic()

    @property
    def is_datagram(self) -> bool:
        """Whether it is UDP."""
        return isinstance(self._spec, UdpBind | UdpConnect)

    def send(self, data: bytes) -> None:
        """Send now; nothing is sent before a peer was heard where we only listen.

        What has arrived is read first: a client that was busy elsewhere would lose the answer,
        because its socket is full.
        """
        self._loop.run_until_complete(self._drain())
        self._link.send(Chunk(0, data, self._peer))
        self._loop.run_until_complete(asyncio.sleep(0))

    def poll(self, until_s: float) -> list[bytes]:
        """What arrives first, at the latest at `until_s`."""
        self._loop.run_until_complete(self._wait(until_s))
        arrived, self._arrived = self._arrived, []
        return arrived

    def another(self) -> WireLink | None:
        """A second client, where the peer is reached by connecting to it."""
        if not isinstance(self._spec, UdpConnect | TcpClient):
            return None
        other = WireLink(self._spec, self._loop)
        other.open()
        self._others.append(other)
        return other

    def close_others(self) -> None:
        """Close the connections made from this one: a server takes so many and no more."""
        while self._others:
            self._others.pop().close()

    def close(self) -> None:
        """Close this connection and those made from it."""
        self.close_others()
        self._loop.run_until_complete(self._close())

    async def _close(self) -> None:
        self._link.close()

    async def _drain(self) -> None:
        before = -1
        while before != len(self._arrived):
            before = len(self._arrived)
            await asyncio.sleep(0)
            await asyncio.sleep(0)  # a reader is called in the turn after its socket was seen

    async def _wait(self, until_s: float) -> None:
        self._wake.clear()
        await asyncio.sleep(0)
        if self._arrived:
            return
        patience_s = until_s - self.now_s
        if patience_s > 0.0:
            with suppress(TimeoutError):
                await asyncio.wait_for(self._wake.wait(), patience_s)

    def _receive(self, chunks: list[Chunk]) -> None:
        for chunk in chunks:
            if self._peer is None:
                self._peer = chunk.peer
            if chunk.peer == self._peer:
                self._arrived.append(chunk.data)
        self._wake.set()


@contextmanager
def open_link(url: str) -> Iterator[WireLink]:
    """The link of a URL, closed at the end; `ConfigError`, `LinkError`: it cannot be opened."""
    spec = parse_transport(url)
    with closing(asyncio.new_event_loop()) as loop:
        link = WireLink(spec, loop)
        try:
            link.open()
            yield link
        finally:
            link.close()
            loop.run_until_complete(asyncio.sleep(0))


EXIT_FAILED = 1
EXIT_BAD_INPUT = 2

DESCRIPTION = """\
Try the rules of MAVLink against an autopilot or a companion.

By default nothing is done that outlasts the connection: it asks, listens and changes stream rates.
--allow-changes overwrites stored missions, fences, parameters, home and the mode of a disarmed
vehicle. --allow-flight also arms and flies: only for a simulator, or without propellers."""
EPILOG = """\
examples:
  companion-conformance --url udpin:127.0.0.1:14550
  companion-conformance --url udpout:127.0.0.1:14580 --only 'parameters.*' --allow-changes
  companion-conformance --url udpout:127.0.0.1:14550 --role companion --flavour ardupilot

exit code: 0 all passed, 1 a rule failed, 2 bad input or nobody there"""


def main(argv: Sequence[str] | None = None) -> int:
    """Try the rules; 0 if nothing failed, 1 if a rule did, 2 for bad input or a silent peer."""
    try:
        return _run(_arguments(argv))
    except (CompanionError, NotApplicable) as error:
        print(f"companion-conformance: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print("companion-conformance: stopped", file=sys.stderr)
        return EXIT_FAILED


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = ComplaintParser(
        prog="companion-conformance",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--url", help="udp:, udpin:, udpout:, tcp:, tcpin: with HOST:PORT, or a serial device")
    add(
        "--role",
        choices=[role.value for role in Role],
        default=Role.VEHICLE.value,
        help="what is there: a vehicle (default) or a companion, which is shown a vehicle",
    )
    add(
        "--flavour",
        choices=[flavour.value for flavour in Flavour],
        default=Flavour.PX4.value,
        help="the autopilot that a companion is shown (default px4); a vehicle tells its own",
    )
    add("--only", metavar="PATTERN", help="rules whose id matches or begins so")
    add("--list", action="store_true", help="print the rules and try none")
    add("--json", metavar="FILE", type=Path, help="write all outcomes there")
    add(
        "--signing-key",
        metavar="FILE",
        type=Path,
        help="the key that the vehicle was given, as for sim-link",
    )
    add("--allow-changes", action="store_true", help="overwrite plans, parameters, home and mode")
    add("--allow-flight", action="store_true", help="arm and fly, too")
    add("--version", action="version", version=f"companion-conformance {__version__}")
    return parser.parse_args(argv)


def _run(arguments: argparse.Namespace) -> int:
    role = Role(arguments.role)
    rules = select(all_rules(), role, arguments.only)
    if not rules:
        raise ConfigError(f"--only {arguments.only}: no rule of a {role.value} is called so")
    if arguments.list:
        for text in listing(rules):
            print(text)
        return 0
    if arguments.url is None:
        raise ConfigError("--url is missing, for example --url udpin:127.0.0.1:14550")
    if arguments.json is not None and not arguments.json.parent.is_dir():
        raise ConfigError(f"--json {arguments.json}: there is no folder {arguments.json.parent}")
    path = arguments.signing_key
    key = None if path is None else load_signing_key(path).secret
    with open_link(arguments.url) as link:
        outcomes = _try_all(rules, arguments, link, key)
    if arguments.json is not None:
        write_json_atomic(arguments.json, record(outcomes, arguments.url))
    print(summary(outcomes))
    return EXIT_FAILED if any(o.verdict is RuleVerdict.FAIL for o in outcomes) else 0


def _try_all(
    rules: Sequence[Rule], arguments: argparse.Namespace, link: WireLink, key: bytes | None
) -> list[RuleOutcome]:
    flavour = Flavour(arguments.flavour)
    is_vehicle = arguments.role == Role.VEHICLE.value

    def make_probe(kind: type[Any]) -> Any:
        link.close_others()
        probe = kind(link, key if is_vehicle else flavour)
        probe.attach()
        return probe

    first = make_probe(VehicleProbe if is_vehicle else CompanionProbe)
    outcomes = []
    for outcome in run_rules(rules, first.flavour, _allowed(arguments), make_probe):
        outcomes.append(outcome)
        print(line(outcome), flush=True)
    return outcomes


def _allowed(arguments: argparse.Namespace) -> Effect:
    if arguments.allow_flight:
        return Effect.FLIES
    return Effect.CHANGES if arguments.allow_changes else Effect.ASKS
