"""The arguments of the `companion` command."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NoReturn

from companion import __version__
from companion.errors import ConfigError

MAX_SECONDS = 300.0
MAX_SPEED = 50.0
"""Beyond this a second of the autopilot's patience is less than a hiccup of the computer."""

DESCRIPTION = """\
Find a radio emitter with a UAV: estimate it from ranging messages, fly crossings over the
estimate, and report where it is and how wrong that may be.

The vehicle is commanded only in offboard mode (PX4 OFFBOARD, ArduPilot GUIDED), which the
operator gives by the mode switch and takes back at any time. To give it back in flight after the
companion fell silent, send it MAV_CMD_NAV_GUIDED_ENABLE (92) with parameter 1 = 1 and switch."""

EPILOG = """\
links:
  udp:HOST:PORT, udpin:HOST:PORT   the companion binds HOST:PORT and answers the autopilot;
                                   without HOST 127.0.0.1, beyond it only with a key
  udpout:HOST:PORT                 the companion sends first, the other side binds
  tcp:HOST:PORT, tcpin:HOST:PORT   connect to, or listen at, HOST:PORT
  serial:/dev/ttyAMA0:921600       a serial port and its speed
  Each may be spelt with :// as well, and udp:// is udpin:// .

examples:
  companion --connect udp:127.0.0.1:14550
  companion --connect serial:/dev/ttyAMA0:921600 --ranging udp:127.0.0.1:14600 \\
            --config configs/companion/default.yaml
  companion demo --speed 4
  companion replay walk.csv --config configs/companion/wifi_rtt.yaml --json walk.json"""


class _Parser(argparse.ArgumentParser):
    """Raises what argparse would print, so that every complaint is one line."""

    def error(self, message: str) -> NoReturn:
        """Refuse the arguments."""
        raise ConfigError(f"{message} (companion --help shows how)")


def argument_parser() -> argparse.ArgumentParser:
    """What the command understands; a complaint is a `ConfigError`."""
    parser = _Parser(
        prog="companion",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"companion {__version__}")
    _add_links(parser)
    _add_configuration(parser)
    _add_security(parser)
    _add_course(parser)
    _add_web(parser)
    commands = parser.add_subparsers(dest="command", metavar="{demo,replay,report,doctor}")
    _add_demo(commands)
    _add_replay(commands)
    _add_report(commands)
    _add_doctor(commands)
    return parser


def _add_links(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--connect", metavar="URL", help="link to the autopilot")
    parser.add_argument(
        "--ranging",
        metavar="URL",
        action="append",
        default=[],
        help="link that carries only ranging messages; repeatable",
    )
    parser.add_argument(
        "--gcs",
        metavar="URL",
        action="append",
        default=[],
        help="link to a ground station, beside the way through the autopilot; repeatable",
    )
    parser.add_argument(
        "--cot",
        metavar="HOST:PORT",
        help="send found emitters as Cursor on Target over UDP, for ATAK (239.2.3.1:6969)",
    )


def _add_configuration(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--config", dest="fly_config", metavar="FILE", type=Path, help="configuration YAML"
    )
    parser.add_argument(
        "--speed",
        dest="fly_speed",
        metavar="X",
        type=_speed,
        help="seconds of a simulator per real second (default 1)",
    )
    parser.add_argument(
        "--fence",
        metavar="FILE",
        type=Path,
        help="QGroundControl .plan or .kml with the fence, instead of the configuration's",
    )


def _add_security(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--signing-key",
        metavar="FILE",
        type=Path,
        help="MAVLink 2 signing with the key in FILE (64 hexadecimal digits, mode 0600)",
    )
    parser.add_argument(
        "--insecure",
        action="store_true",
        help="listen beyond this machine even without a key: anyone may then command the vehicle",
    )


def _add_course(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--fresh",
        action="store_true",
        help="take up nothing of an earlier run that did not end in order",
    )
    parser.add_argument("--once", action="store_true", help="end after the target is reported")
    parser.add_argument("--quiet", action="store_true", help="only warnings and errors")


def _add_web(parser: argparse.ArgumentParser) -> None:
    web = parser.add_argument_group("live map (extra web)")
    web.add_argument(
        "--web",
        dest="fly_web",
        metavar="[HOST:]PORT",
        help="serve the live map; without HOST to this computer only, beyond it with a token",
    )
    web.add_argument("--web-control", action="store_true", help="with HOLD, RESUME and RETURN")
    web.add_argument("--web-token", metavar="TEXT", help="token instead of one made up")
    web.add_argument("--web-open", action="store_true", help="looking needs no token, buttons do")
    web.add_argument("--web-tiles", metavar="DIR", type=Path, help="map tiles, z/x/y.png")


def _add_demo(commands: argparse._SubParsersAction[_Parser]) -> None:
    demo = commands.add_parser(
        "demo",
        help="fly the canonical search on the simulator and watch it",
        description="Start sim-link, fly the canonical search over UDP, and show how well it went.",
    )
    demo.add_argument("--seed", metavar="N", type=_seed, default=1, help="of the simulator")
    demo.add_argument("--speed", metavar="X", type=_speed, default=1.0, help="times real time")
    demo.add_argument("--scenario", metavar="FILE", type=Path, help="scenario for sim-link")
    demo.add_argument(
        "--autopilot",
        choices=("px4", "ardupilot"),
        help="which autopilot to fly (default: the scenario's, px4)",
    )
    demo.add_argument("--config", metavar="FILE", type=Path, help="companion configuration")
    demo.add_argument("--json", metavar="FILE", type=Path, help="write the result as JSON")
    demo.add_argument(
        "--plot", metavar="FILE", type=Path, default=Path("track.png"), help="where to draw"
    )
    demo.add_argument(
        "--web",
        metavar="[HOST:]PORT",
        nargs="?",
        const="8080",
        help="serve the live map, with buttons (default port 8080)",
    )
    demo.add_argument("--no-plot", action="store_true", help="do not draw the track")


def _add_doctor(commands: argparse._SubParsersAction[_Parser]) -> None:
    doctor = commands.add_parser(
        "doctor",
        help="look at autopilot, link and computer before a flight",
        description="Check autopilot, link and computer as a flight needs them, and name the "
        "remedy for what is wrong. Nothing is armed, switched or set. Exit code 1: do not fly.",
    )
    doctor.add_argument(
        "--connect", dest="link", metavar="URL", required=True, help="link to the autopilot"
    )
    doctor.add_argument("--config", metavar="FILE", type=Path, help="companion configuration")
    doctor.add_argument("--signing-key", dest="key", metavar="FILE", type=Path, help="as in flight")
    doctor.add_argument("--insecure", dest="is_insecure", action="store_true", help="as in flight")
    doctor.add_argument(
        "--seconds", metavar="S", type=_seconds, default=5.0, help="to count streams (default 5)"
    )
    doctor.add_argument("--json", action="store_true", help="print the findings as JSON")


def _add_replay(commands: argparse._SubParsersAction[_Parser]) -> None:
    replay = commands.add_parser(
        "replay",
        help="run a recorded flight or ranging walk again",
        description="Run a recorded flight through the flying code once more and say whether it "
        "is the same, or, with another configuration, how it differs. A CSV file is a recorded "
        "ranging walk: it goes through the estimator, a filter per target.",
    )
    replay.add_argument("file", metavar="FLIGHT|FILE.tlog|FILE.csv", type=Path)
    replay.add_argument(
        "--speed",
        metavar="X",
        type=_speed,
        help="of a flight, times real time (default: all at once)",
    )
    replay.add_argument(
        "--web",
        dest="replay_web",
        metavar="[HOST:]PORT",
        nargs="?",
        const="8080",
        help="show a flight on the live map, at --speed 1 unless given (default port 8080)",
    )
    replay.add_argument("--config", metavar="FILE", type=Path, help="companion configuration")
    replay.add_argument("--json", metavar="FILE", type=Path, help="write the results as JSON")


def _add_report(commands: argparse._SubParsersAction[_Parser]) -> None:
    report = commands.add_parser(
        "report",
        help="make the report of a recorded flight",
        description="Make one self-contained HTML page of a flight's event log, and print where it "
        "is. Every flight gets one at its end.",
    )
    report.add_argument("flight", metavar="FLIGHT", type=Path, help="its folder, or a file in it")
    report.add_argument("--output", metavar="FILE", type=Path, help="instead of report.html there")


def _speed(text: str) -> float:
    try:
        speed = float(text)
    except ValueError:
        speed = 0.0
    if not 0.0 < speed <= MAX_SPEED:
        raise argparse.ArgumentTypeError(f"`{text}` is not above 0 and at most {MAX_SPEED:g}")
    return speed


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not 1.0 <= seconds <= MAX_SECONDS:
        raise argparse.ArgumentTypeError(f"`{text}` is not 1 to {MAX_SECONDS:g}")
    return seconds


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"`{text}` is not a whole number from 0 up")
    return int(text)


def check_place_of_options(arguments: argparse.Namespace) -> None:
    """Refuse options of flying in front of a subcommand, which would not see them."""
    if arguments.command is None:
        return
    given = [
        f"--{name}"
        for name in (
            "connect",
            "ranging",
            "gcs",
            "cot",
            "fence",
            "signing-key",
            "insecure",
            "fresh",
            "once",
        )
        if getattr(arguments, name.replace("-", "_")) not in (None, [], False)
    ]
    given += [
        f"--{n}" for n in ("config", "speed", "web") if getattr(arguments, f"fly_{n}") is not None
    ]
    if given:
        word = arguments.command
        raise ConfigError(f"{given[0]} in front of `{word}` has no effect; put options after it")
