"""The `companion-conformance` command: its rules, the real link, arguments and exit codes.

The links of `companion.io` run on an event loop, but a probe is a script. So a separate loop runs
only while a probe waits.
"""

from __future__ import annotations

import argparse
import asyncio
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from functools import partial
from pathlib import Path

from companion import __version__
from companion.arguments import RaisingParser
from companion.entry import ignore_broken_pipe
from companion.errors import CompanionError, ConfigError
from companion.io.files import write_json_atomic
from companion.io.links import transports
from companion.io.links.link import Link
from companion.io.state_directory import load_signing_key
from companion.mav.endpoint import Address, Chunk
from sim_link.lab.conformance import companion_rules, rules
from sim_link.lab.conformance.rule_run import RuleRun, RunOptions
from sim_link.lab.conformance.vehicle_probe import SILENCE_S
from sim_link.lab.conformance.vehicle_rules import (
    command_rules,
    connection_rules,
    flight_rules,
    frame_rules,
    mission_rules,
    parameter_rules,
    setpoint_rules,
    signing_rules,
    telemetry_rules,
    upload_rules,
)

MODULES = (
    frame_rules,
    connection_rules,
    signing_rules,
    command_rules,
    telemetry_rules,
    parameter_rules,
    mission_rules,
    upload_rules,
    flight_rules,
    setpoint_rules,
    companion_rules,
)


def all_rules() -> list[rules.Rule]:
    """Return every rule of every role, ordered by effect: asking first, flying last."""
    books = (getattr(each, "book", None) for module in MODULES for each in vars(module).values())
    found = {r.rule_id: r for book in books if isinstance(book, rules.RuleBook) for r in book.rules}
    order = list(rules.Effect)
    return sorted(found.values(), key=lambda rule: order.index(rule.effect))


CONNECT_GRACE_S = 0.3
"""Longest time in s until a TCP connection or serial device sends its first byte."""


class WireLink:
    """One open connection; a `ProbeLink`."""

    def __init__(self, spec: transports.Transport, loop: asyncio.AbstractEventLoop) -> None:
        self._spec = spec
        self._loop = loop
        self._arrived: list[bytes] = []
        self._peer: Address | None = None
        self._heard_s = 0.0
        self._wake = asyncio.Event()
        self._is_interrupted = False
        self._others: list[WireLink] = []
        self._link: Link = transports.make_link(spec, 0, self._receive)

    def open(self) -> None:
        """Bind or connect; raise `LinkError` if the link cannot be opened."""
        self._loop.run_until_complete(self._link.open())
        if isinstance(self._spec, transports.TcpClient | transports.SerialPort):
            self._loop.run_until_complete(asyncio.sleep(CONNECT_GRACE_S))

    @property
    def now_s(self) -> float:
        """The wall clock, monotonic."""
        return time.monotonic()

    @property
    def is_datagram(self) -> bool:
        """True if the link is UDP."""
        return isinstance(self._spec, transports.UdpBind | transports.UdpConnect)

    def send(self, data: bytes) -> None:
        """Send now; a listening link sends nothing before a peer was heard.

        Received data is read first, because an answer would be lost to a full socket.
        """
        self._loop.run_until_complete(self._drain())
        self._link.send(Chunk(0, data, self._peer))
        self._loop.run_until_complete(asyncio.sleep(0))

    def poll(self, until_s: float) -> list[bytes]:
        """Return the first datagrams that arrive, waiting until `until_s` at most."""
        self._loop.run_until_complete(self._wait(until_s))
        if self._is_interrupted:
            self._is_interrupted = False
            raise KeyboardInterrupt
        arrived, self._arrived = self._arrived, []
        return arrived

    def interrupt(self) -> None:
        """Interrupt the waiting caller: a signal in the middle of the loop would break it."""
        self._is_interrupted = True
        self._wake.set()

    def another(self) -> WireLink | None:
        """Return a second client; None if the peer is not reached by connecting to it."""
        if not isinstance(self._spec, transports.UdpConnect | transports.TcpClient):
            return None
        other = WireLink(self._spec, self._loop)
        other.open()
        self._others.append(other)
        return other

    def close_others(self) -> None:
        """Close the connections made from this one: a server accepts only a few."""
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
        if self._arrived or self._is_interrupted:
            return
        left_s = until_s - self.now_s
        if left_s > 0.0:
            with suppress(TimeoutError):
                await asyncio.wait_for(self._wake.wait(), left_s)

    def _receive(self, chunks: list[Chunk]) -> None:
        for chunk in chunks:
            if self._peer is None or self.now_s - self._heard_s > SILENCE_S:
                self._peer = chunk.peer  # after a restart it may have another port
            if chunk.peer == self._peer:
                self._heard_s = self.now_s
                self._arrived.append(chunk.data)
        self._wake.set()


@contextmanager
def open_link(url: str) -> Iterator[WireLink]:
    """The link of a URL, closed at the end; `ConfigError`, `LinkError`: it cannot be opened."""
    spec = transports.parse_transport(url)
    with closing(asyncio.new_event_loop()) as loop:
        link = WireLink(spec, loop)
        with suppress(ValueError, RuntimeError):  # not in the main thread: no signals there
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                loop.add_signal_handler(number, link.interrupt)
        try:
            link.open()
            yield link
        finally:
            link.close()
            loop.run_until_complete(asyncio.sleep(0))


DESCRIPTION = """\
Try the rules of MAVLink against an autopilot or a companion.

By default nothing is done that outlasts the connection: it asks, listens and changes stream rates.
--allow-changes overwrites stored missions, fences, parameters, home and the mode of a disarmed
vehicle. --allow-flight also arms and flies: only for a simulator, or without propellers.
--allow-harm adds what a weak autopilot may not survive: NaN and absurd values, calibration, reboots
and a disarming in the air. What was changed is put back after each rule, or listed at the end."""
EPILOG = """\
examples:
  companion-conformance --url udpin:127.0.0.1:14550
  companion-conformance --url udpout:127.0.0.1:14580 --only 'parameters.*' --allow-changes
  companion-conformance --url udpout:127.0.0.1:14550 --role companion --flavour ardupilot

exit code: 0 all that was tried passed; 3 it deviates, but only as the real PX4 1.15.2 or ArduCopter
4.5.7 is noted to; 1 a rule failed, the vehicle fell silent, or the run did not come to its end;
2 bad input or no peer"""


def main(argv: Sequence[str] | None = None) -> int:
    """Try the rules; return the exit code of `EPILOG`."""
    ignore_broken_pipe()
    try:
        return _run(parsed_arguments(argv))
    except (CompanionError, rules.NotApplicable) as error:
        print(f"companion-conformance: {error}", file=sys.stderr)
        return rules.EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print("companion-conformance: stopped", file=sys.stderr)
        return rules.EXIT_FAILED


def parsed_arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    """Parse the arguments; bad ones raise a `ConfigError`."""
    parser = RaisingParser(
        prog="companion-conformance",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--url", help="udp:, udpin:, udpout:, tcp:, tcpin: with HOST:PORT, or a serial device")
    add(
        "--role",
        choices=[role.value for role in rules.Role],
        default=rules.Role.VEHICLE.value,
        help="peer: a vehicle (default) or a companion, which is shown a vehicle",
    )
    add(
        "--flavour",
        choices=[flavour.value for flavour in rules.Flavour],
        default=rules.Flavour.PX4.value,
        help="the autopilot that a companion is shown (default px4); a vehicle reports its own",
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
    add("--allow-harm", action="store_true", help="send NaN and absurd values, reboot, too")
    add("--version", action="version", version=f"companion-conformance {__version__}")
    return parser.parse_args(argv)


def _run(arguments: argparse.Namespace) -> int:
    role = rules.Role(arguments.role)
    chosen = rules.select(all_rules(), role, arguments.only)
    if not chosen:
        raise ConfigError(f"--only {arguments.only}: no rule of a {role.value} has this name")
    say = partial(print, flush=True)
    if arguments.list:
        for text in rules.listing(chosen):
            say(text)
        return 0
    if arguments.url is None:
        raise ConfigError("--url is missing, for example --url udpin:127.0.0.1:14550")
    if arguments.json is not None and not arguments.json.parent.is_dir():
        raise ConfigError(f"--json {arguments.json}: there is no folder {arguments.json.parent}")
    path = arguments.signing_key
    key = None if path is None else load_signing_key(path).secret
    options = RunOptions(role, rules.Flavour(arguments.flavour), key, _allowed(arguments))
    with open_link(arguments.url) as link:
        run = RuleRun(
            link, options, lambda each: say(rules.line(each)), lambda text: say(f"... {text}")
        )
        try:
            run.run(chosen)
        finally:
            _close(run, arguments, say)
    return rules.exit_code(run.outcomes, run.problems)


def _close(run: RuleRun, arguments: argparse.Namespace, say: Callable[[str], None]) -> None:
    """Print and write the outcomes, however the run ended."""
    if not run.outcomes:
        return
    for text in [*run.problems, rules.summary(run.outcomes)]:
        say(text)
    if arguments.json is not None:
        write_json_atomic(arguments.json, rules.record(run.outcomes, arguments.url, run.problems))


def _allowed(arguments: argparse.Namespace) -> frozenset[str]:
    flags = {
        rules.CHANGE_FLAG: arguments.allow_changes or arguments.allow_flight,
        rules.FLIGHT_FLAG: arguments.allow_flight,
        rules.HARM_FLAG: arguments.allow_harm,
    }
    return frozenset(flag for flag, is_given in flags.items() if is_given)
