"""The `sim-link` command: arguments, lines for people and exit codes."""

from __future__ import annotations

import argparse
import os
import queue
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import get_args

import msgspec

from companion import __version__
from companion.arguments import RaisingParser, number_in
from companion.entry import OutputLostError, ignore_broken_pipe, is_interrupt, obey_termination
from companion.errors import CompanionError, ConfigError, decoding_problem
from companion.io.child_processes import clock_of
from companion.io.links.transports import Transport, parse_transport, udp_address
from companion.io.shell import Shell
from companion.mav.endpoint import Endpoint
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.incidents import Incident
from sim_link.autopilot.protocols.addressing import LinkMode
from sim_link.autopilot.scenario import Scenario
from sim_link.fleet import (
    Fleet,
    FleetFiles,
    FleetOptions,
    has_signing_ended,
    link_specs,
    links_of_others,
    load_scenario,
    make_vehicles,
    udp_ports,
)
from sim_link.neighbours import FleetAmongOthers

DEFAULT_LISTEN = "127.0.0.1:14580"
DEFAULT_SEND_TO = ("127.0.0.1:14550", "127.0.0.1:14540")
EXIT_FAILED = 1
EXIT_BAD_INPUT = 2
MAX_SPEED = 1000.0
MAX_VEHICLES = 250
MAX_BOOT_S = 3600.0

DESCRIPTION = """\
Fly a simulated PX4 or ArduPilot multicopter with a radio payload that measures a hidden emitter.

It speaks MAVLink 2 over UDP, sends unasked to every --send-to address, and answers every peer that
sends to --listen. It runs until it is stopped (Ctrl-C, SIGTERM)."""
EPILOG = """\
example:
  sim-link --seed 7 --report truth.json
  flies the canonical scenario for a companion on UDP 14540 and a ground station on UDP 14550,
  and writes where the emitter really is to truth.json.

more:
  sim-link mission run FILE...   fly mission scripts and report pass or fail
  sim-link radio --follow URL    a radio payload for a vehicle that has none
  sim-link proxy --fault MAPPING  a bad link between a vehicle and a companion"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the simulator until it is stopped, or a subcommand; return the exit code.

    0 after a stop, 1 after an interrupt before the start, 2 for bad input or a port that is taken.
    """
    given = sys.argv[1:] if argv is None else list(argv)
    ignore_broken_pipe()
    if argv is None:  # a process of its own
        obey_termination()
    try:
        try:
            if given and not given[0].startswith("-"):
                return run_subcommand(given)
            return _run(simulator_parser().parse_args(given))
        finally:  # also after --help
            sys.stdout.flush()
    except CompanionError as error:
        print(f"sim-link: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except OutputLostError as error:
        print(f"sim-link: standard output: {error.strerror}", file=sys.stderr)
        sys.stdout = sys.stderr  # which drops the rest silently
        return EXIT_FAILED
    except (KeyboardInterrupt, SystemError) as problem:  # before what has an end of its own
        if not is_interrupt(problem):
            raise
        print("sim-link: interrupted", file=sys.stderr)
        return EXIT_FAILED


def run_subcommand(argv: Sequence[str]) -> int:
    """Run a subcommand, return the exit code; `CompanionError`: bad input, or it cannot be done."""
    arguments = subcommand_parser().parse_args(argv)
    code: int = arguments.run(arguments)
    return code


def subcommand_parser() -> RaisingParser:
    """Return the parser of `sim-link` with a subcommand."""
    from sim_link.lab import radio_follower
    from sim_link.lab.faults import faulty_link
    from sim_link.lab.mission import mission_cli

    parser = RaisingParser(prog="sim-link")
    commands = parser.add_subparsers(required=True, metavar="{mission,radio,proxy}")
    mission = commands.add_parser("mission", help="fly mission scripts")
    kinds = mission.add_subparsers(required=True, metavar="{run}")
    for below, name, summary, module in (
        (kinds, "run", "fly scripts and report pass or fail", mission_cli),
        (commands, "radio", "a radio payload for a vehicle that has none", radio_follower),
        (commands, "proxy", "a bad link between a vehicle and a companion", faulty_link),
    ):
        subcommand = below.add_parser(
            name,
            help=summary,
            description=module.DESCRIPTION,
            epilog=module.EPILOG,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        module.add_arguments(subcommand)
        subcommand.set_defaults(run=module.run)
    return parser


def simulator_parser() -> RaisingParser:
    """Return the parser of `sim-link` without subcommands; bad arguments raise `ConfigError`."""
    parser = RaisingParser(
        prog="sim-link",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    for add_options in (_add_scene, _add_links, _add_files):
        add_options(parser.add_argument)
    parser.add_argument("--quiet", action="store_true", help="do not print mode changes")
    parser.add_argument("--version", action="version", version=f"sim-link {__version__}")
    return parser


def _add_scene(add: Callable[..., object]) -> None:
    scenario = "scenario YAML, for example configs/scenarios/canonical.yaml (default: the "
    scenario += "canonical scenario, built in)"
    add("--scenario", metavar="FILE", type=Path, help=scenario)
    autopilot = "autopilot to simulate (default: the scenario's, px4)"
    add("--autopilot", choices=("px4", "ardupilot"), help=autopilot)
    seed = "seed of all randomness (default 0)"
    add("--seed", metavar="N", type=number_in(0, kind=int), default=0, help=seed)
    speed = "simulated seconds per real second (default 1)"
    above_zero = number_in(0.0, MAX_SPEED, is_open=True)
    add("--speed", metavar="X", type=above_zero, default=1.0, help=speed)
    ready = "seconds after boot until it can be armed (default: the scenario's, 2; the real PX4 "
    ready += "takes 34, ArduPilot 41)"
    add("--ready-after", metavar="S", type=number_in(0.0, MAX_BOOT_S), help=ready)
    vehicles = "fly N of them: system ids and ports count up, 14550 is for all (default 1)"
    add("--vehicles", metavar="N", type=number_in(1, MAX_VEHICLES, kind=int), help=vehicles)


def _add_links(add: Callable[..., object]) -> None:
    send_to = "send unasked to this UDP address; repeatable (default "
    send_to += f"{' and '.join(DEFAULT_SEND_TO)})"
    add("--send-to", metavar="HOST:PORT", action="append", help=send_to)
    listen = f"bind this UDP address (default {DEFAULT_LISTEN})"
    add("--listen", metavar="HOST:PORT", default=DEFAULT_LISTEN, help=listen)
    link = "one more link, with streams of its own: udpin:HOST:PORT, tcpin:HOST:PORT (several "
    link += "clients), serial:/dev/...:BAUD or pty:PATH; #station or #narrow behind it gives it "
    link += "the rates that PX4 has there; repeatable"
    add("--link", metavar="URL", action="append", default=[], help=link)
    share = "let up to 16 clients share a UDP port of PX4, which by itself answers only the first"
    add("--share-ports", action="store_true", help=share)


def _add_files(add: Callable[..., object]) -> None:
    parameters = "load the autopilot's parameters from FILE, and store there what a client "
    parameters += "changes; a FILE that does not exist yet is made then"
    add("--parameters", metavar="FILE", type=Path, help=parameters)
    key = "sign, and accept only frames signed with this key; SETUP_SIGNING replaces it"
    add("--signing-key", metavar="FILE", type=Path, help=key)
    report = "write the truth as JSON at the start, and the flight with it at the end"
    add("--report", metavar="FILE", type=Path, help=report)
    eof = "stop when standard input ends: a parent that dies leaves no simulator behind; "
    eof += "incidents of a scenario, as JSON lines there, happen at once to the first vehicle"
    add("--stop-on-eof", action="store_true", help=eof)


def _run(arguments: argparse.Namespace) -> int:
    options = _fleet_options(arguments)
    endpoints = make_vehicles(options)
    specs = [link_specs(options, number) for number in range(len(endpoints))]
    files = FleetFiles(options, endpoints)
    files.begin()

    orders: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def on_wakeup(now_s: float) -> None:
        files.keep(now_s)
        _apply_incidents(endpoints[0], orders, now_s)
        for endpoint in endpoints:
            who = f"{endpoint.vehicle.system_id:3d}  " if len(endpoints) > 1 else ""
            for occurrence in endpoint.take_occurrences():
                if not arguments.quiet:
                    print(f"{occurrence.time_s:8.2f} s  {who}{occurrence.text}", flush=True)

    print(_start_line(options), flush=True)
    for line in _notes(options):
        print(line, flush=True)
    fleet: Endpoint = endpoints[0] if len(endpoints) == 1 else Fleet(endpoints, len(specs[0]))
    links = [spec for own in specs for spec in own]
    sky = None
    if options.scenario.other_vehicles:
        fleet = sky = FleetAmongOthers(fleet, options.scenario, len(links), len(specs[0]))
        links += links_of_others(options)
    try:
        shell = Shell(fleet, links, clock_of(options.speed), on_wakeup)
        if arguments.stop_on_eof:
            threading.Thread(target=_read_input, args=(shell, orders), daemon=True).start()
        shell.run_blocking()
    finally:
        files.end()
    for endpoint in endpoints:
        print(_summary(endpoint), flush=True)
    for other in () if sky is None else sky.others:
        print(f"sim-link: {other.summary}", flush=True)
    return 0


def _fleet_options(arguments: argparse.Namespace) -> FleetOptions:
    report: Path | None = arguments.report
    if report is not None and not report.name:
        raise ConfigError(f"--report {report}: give the name of a file")
    return FleetOptions(
        scenario=_scenario(arguments),
        seed=arguments.seed,
        speed=arguments.speed,
        listen=udp_address("--listen", arguments.listen),
        send_to=tuple(
            udp_address("--send-to", text) for text in arguments.send_to or DEFAULT_SEND_TO
        ),
        links=tuple(map(_link, arguments.link)),
        shares_ports=arguments.share_ports,
        parameters=arguments.parameters,
        signing_key=arguments.signing_key,
        report=report,
    )


def _scenario(arguments: argparse.Namespace) -> Scenario:
    """Return the scenario; options of the command line override its file."""
    scenario = load_scenario(arguments.scenario) if arguments.scenario else Scenario()
    vehicles, ready_after_s = arguments.vehicles, arguments.ready_after
    given = {"flavour": arguments.autopilot, "ready_after_s": ready_after_s}
    chosen = {name: value for name, value in given.items() if value is not None}
    return msgspec.structs.replace(
        scenario,
        autopilot=msgspec.structs.replace(scenario.autopilot, **chosen),
        vehicles=scenario.vehicles if vehicles is None else vehicles,
    )


def _read_input(shell: Shell, orders: queue.SimpleQueue[bytes]) -> None:
    """Deliver the input line by line, and stop at its end."""
    rest = b""
    while data := os.read(sys.stdin.fileno(), 4096):
        *lines, rest = (rest + data).split(b"\n")
        for line in lines:
            orders.put(line)
    shell.request_stop()


def _apply_incidents(endpoint: SimEndpoint, orders: queue.SimpleQueue[bytes], now_s: float) -> None:
    """Apply the requested incidents, JSON as in a scenario; anything else is refused."""
    while not orders.empty():
        line = orders.get()
        try:
            endpoint.apply_incident(msgspec.json.decode(line, type=Incident), now_s)
        except (msgspec.DecodeError, ValueError) as error:
            print(
                f"sim-link: {line!r} is not an incident: {decoding_problem(error)}", file=sys.stderr
            )


def _link(text: str) -> tuple[Transport, LinkMode | None]:
    """Return a link and the kind of its peer, which may follow after `#`."""
    url, mark, name = text.partition("#")
    modes: dict[str, LinkMode] = {mode: mode for mode in get_args(LinkMode)}
    if mark and name not in modes:
        raise ConfigError(f"--link {text}: after # give one of {', '.join(modes)}")
    return parse_transport(url), modes.get(name)


def _start_line(options: FleetOptions) -> str:
    scenario, listen = options.scenario, options.listen
    targets = ", ".join(f"{host}:{port}" for host, port in options.send_to)
    ports = " and ".join(str(port) for _, port, _ in udp_ports(options))
    count = f"{scenario.vehicles} vehicles, " if scenario.vehicles > 1 else ""
    also = "".join(f", {url}" for url, _ in options.links)
    return (
        f"sim-link: {count}{scenario.autopilot.flavour}, scenario {scenario.name}, "
        f"seed {options.seed}, speed {options.speed:g}x; "
        f"sending to {targets}; listening on {listen[0]}:{ports}{also}"
    )


def _notes(options: FleetOptions) -> list[str]:
    notes, parameters, key = [], options.parameters, options.signing_key
    if parameters is not None and not parameters.exists():
        notes.append(f"sim-link: {parameters} is not there yet; changes will be stored there")
    if key is not None and has_signing_ended(key):
        notes.append(f"sim-link: signing is off, a client ended it ({key})")
    return notes


def _summary(endpoint: SimEndpoint) -> str:
    vehicle, aircraft = endpoint.vehicle, endpoint.vehicle.aircraft
    return (
        f"sim-link: stopped after {vehicle.time_s:.1f} s; flew {aircraft.flight_time_s:.1f} s "
        f"and {aircraft.distance_m:.0f} m; {vehicle.setpoints.received} setpoints received, "
        f"{vehicle.setpoints.refused} refused"
    )
