"""The `companion-conformance` command: arguments, lines for people and exit codes."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from companion import __version__
from companion.errors import CompanionError, ConfigError
from companion.io.files import write_json_atomic
from companion.io.state.signing_keys import load_signing_key
from sim_link.conformance.catalogue import all_rules
from sim_link.conformance.puppet import CompanionProbe
from sim_link.conformance.report import line, listing, record, summary
from sim_link.conformance.rules import Effect, Flavour, NotApplicable, Role, Rule
from sim_link.conformance.runner import Outcome, Verdict, run_rules, select
from sim_link.conformance.vehicle_probe import VehicleProbe
from sim_link.conformance.wire import WireLink, open_link

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


class _Parser(argparse.ArgumentParser):
    """Raises what argparse would print, so that every complaint is one line."""

    def error(self, message: str) -> NoReturn:
        """Refuse the arguments."""
        raise ConfigError(f"{message} (companion-conformance --help shows how)")


def main(argv: Sequence[str] | None = None) -> int:
    """Try the rules.

    Args:
        argv: Arguments without the program's name; None takes the process's.

    Returns:
        0 if nothing failed, 1 if a rule did, 2 for bad input or a silent peer.
    """
    try:
        return _run(_arguments(argv))
    except (CompanionError, NotApplicable) as error:
        print(f"companion-conformance: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print("companion-conformance: stopped", file=sys.stderr)
        return EXIT_FAILED


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = _Parser(
        prog="companion-conformance",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--url", help="udp:, udpin:, udpout:, tcp:, tcpin: with HOST:PORT, or a serial device"
    )
    parser.add_argument(
        "--role",
        choices=[role.value for role in Role],
        default=Role.VEHICLE.value,
        help="what is there: a vehicle (default) or a companion, which is shown a vehicle",
    )
    parser.add_argument(
        "--flavour",
        choices=[flavour.value for flavour in Flavour],
        default=Flavour.PX4.value,
        help="the autopilot that a companion is shown (default px4); a vehicle tells its own",
    )
    parser.add_argument("--only", metavar="PATTERN", help="rules whose id matches or begins so")
    parser.add_argument("--list", action="store_true", help="print the rules and try none")
    parser.add_argument("--json", metavar="FILE", type=Path, help="write all outcomes there")
    parser.add_argument(
        "--signing-key",
        metavar="FILE",
        type=Path,
        help="the key that the vehicle was given, as for sim-link",
    )
    parser.add_argument(
        "--allow-changes", action="store_true", help="overwrite plans, parameters, home and mode"
    )
    parser.add_argument("--allow-flight", action="store_true", help="arm and fly, too")
    parser.add_argument(
        "--version", action="version", version=f"companion-conformance {__version__}"
    )
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
    key = _signing_key(arguments.signing_key)
    with open_link(arguments.url) as link:
        outcomes = _try_all(rules, arguments, link, key)
    if arguments.json is not None:
        write_json_atomic(arguments.json, record(outcomes, arguments.url))
    print(summary(outcomes))
    return EXIT_FAILED if any(o.verdict is Verdict.FAIL for o in outcomes) else 0


def _try_all(
    rules: Sequence[Rule], arguments: argparse.Namespace, link: WireLink, key: bytes | None
) -> list[Outcome]:
    flavour = Flavour(arguments.flavour)
    is_vehicle = arguments.role == Role.VEHICLE.value

    def make_probe() -> VehicleProbe | CompanionProbe:
        """A fresh probe of the same role."""
        link.close_others()
        probe = VehicleProbe(link, key) if is_vehicle else CompanionProbe(link, flavour)
        probe.attach()
        return probe

    first = make_probe()
    outcomes = []
    for outcome in run_rules(rules, first.flavour, _allowed(arguments), make_probe):
        outcomes.append(outcome)
        print(line(outcome), flush=True)
    return outcomes


def _allowed(arguments: argparse.Namespace) -> Effect:
    if arguments.allow_flight:
        return Effect.FLIES
    return Effect.CHANGES if arguments.allow_changes else Effect.ASKS


def _signing_key(path: Path | None) -> bytes | None:
    return None if path is None else load_signing_key(path).secret
