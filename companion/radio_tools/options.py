"""Options of `companion radio`, apart so that a flight loads nothing else of it."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Literal, get_args

FieldTestName = Literal["turn", "line", "circle", "blocked"]
TEST_NAMES: tuple[FieldTestName, ...] = get_args(FieldTestName)
COMMANDS = "{list,identify,watch,record,calibrate}"
CALIBRATE = """\
Find a radio's offset, scale, sign, mount, lag and noise from a recording of it about a known
point: a turn, a line, a circle and a blocked run. Prints a verdict, and YAML for the radio's
`settings` and for `estimation.filter`. Exit code 1: something was refused, with the reason."""


def add_radio(parser: argparse.ArgumentParser) -> None:
    """Add the options and commands of `companion radio`."""
    commands = parser.add_subparsers(dest="radio_command", metavar=COMMANDS, required=True)
    commands.add_parser("list", help="every radio that can be chosen, and what it gives")
    identify = commands.add_parser(
        "identify",
        help="listen ten seconds, and say which radio it is and what to type",
        description="Listen at an address, a serial port at its usual speeds, and name the radio.",
    )
    identify.add_argument("url", metavar="@URL", help="as in NAME@URL")
    identify.add_argument("--seconds", metavar="S", type=float, default=10.0, help="in all")
    watch = commands.add_parser(
        "watch",
        help="show what a radio says, live",
        description="Show what radios say: rate, range, bearing, scatter, and what is refused.",
    )
    watch.add_argument("radios", metavar="RADIO", nargs="*", help="NAME[:KEY=VALUE,...]@URL")
    _add_common(watch)
    record = commands.add_parser(
        "record",
        help="keep what radios send, and where the vehicle is meanwhile",
        description="Keep the bytes of radios with their times and, where connected, the vehicle's "
        "position and attitude. `companion replay FILE` runs it through the estimator.",
    )
    record.add_argument("file", metavar="FILE", type=Path)
    record.add_argument(
        "--radio", metavar="RADIO", action="append", default=[], dest="radios", help="as in flight"
    )
    record.add_argument("--connect", metavar="URL", dest="link", help="link to the autopilot")
    _add_common(record)
    fitted = commands.add_parser(
        "calibrate",
        help="find offset, scale, sign, mount, lag and noise from a recording about a known point",
        description=CALIBRATE,
    )
    _add_calibrate(fitted)


def _add_common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config", metavar="FILE", type=Path, help="companion configuration")
    text = "end after so many seconds (default: Ctrl-C)"
    parser.add_argument("--seconds", metavar="S", type=float, help=text)
    text = "listen beyond this machine, too"
    parser.add_argument("--insecure", action="store_true", dest="is_insecure", help=text)


def _add_calibrate(parser: argparse.ArgumentParser) -> None:
    text = "recording of `companion radio record`; with --radio it is written first"
    parser.add_argument("file", metavar="FILE", nargs="?", type=Path, help=text)
    text = "the emitter is so many metres from the antenna: find the radio's offset, and keep it"
    parser.add_argument("--beside", metavar="M", type=float, help=text)
    text = "a ranging walk as of `companion replay`, with target_x_m and target_y_m"
    parser.add_argument("--from-csv", metavar="FILE", type=Path, dest="csv", help=text)
    text = "where the emitter is, in degrees and metres above mean sea level (default: home's)"
    parser.add_argument("--point", metavar="LAT,LON[,AMSL]", help=text)
    text = "the same in metres east, north and up of the autopilot's origin"
    parser.add_argument("--point-enu", metavar="E,N,U", help=text)
    parser.add_argument("--emitter", metavar="ID", help="its id, where there are several")
    text = f"what FILE contains, {', '.join(TEST_NAMES)}, and when, in seconds; repeatable"
    parser.add_argument(
        "--test", metavar="NAME[@FROM-TO]", action="append", default=[], dest="tests", help=text
    )
    text = "record this radio first, NAME[:KEY=VALUE,...]@URL; repeatable"
    parser.add_argument(
        "--radio", metavar="RADIO", action="append", default=[], dest="radios", help=text
    )
    parser.add_argument("--connect", metavar="URL", dest="link", help="link to the autopilot")
    parser.add_argument("--config", metavar="FILE", type=Path, help="companion configuration")
    text = "record so long (default: Ctrl-C)"
    parser.add_argument("--seconds", metavar="S", type=float, help=text)
    text = "listen beyond this machine, too"
    parser.add_argument("--insecure", action="store_true", dest="is_insecure", help=text)
    parser.add_argument("--json", metavar="FILE", type=Path, help="write all figures as JSON")
