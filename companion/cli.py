"""The `companion` command: arguments, lines for people and exit codes."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from companion import __version__
from companion.config.schema import CompanionConfig, load_config, with_signing_key
from companion.errors import CompanionError, ConfigError
from companion.io.clock import Clock
from companion.io.console import ConsoleHandler
from companion.io.exposure import check_exposure
from companion.io.files import check_writable, write_json_atomic
from companion.io.links import link_from_url
from companion.io.urls import parse_link_url
from companion.replay.command import Pace, replay_flight
from companion.replay.walk import replay_walk, table
from companion.run import fly
from companion.web.settings import WebSettings, web_settings
from companion.web.view import WebView

EXIT_FAILED = 1
EXIT_BAD_INPUT = 2
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


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command.

    Args:
        argv: Arguments without the program's name; None takes the process's.

    Returns:
        0 for success, 1 for a failed run, 2 for bad input or a link that cannot be opened.
    """
    try:
        try:
            return _run(argv)
        finally:  # what was logged comes before what is printed below
            for handler in logging.getLogger("companion").handlers:
                handler.close()
    except CompanionError as error:
        for line in str(error).splitlines():
            print(f"companion: {line}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print("companion: interrupted", file=sys.stderr)
        return EXIT_FAILED
    except BrokenPipeError:
        sys.stderr.close()
        return EXIT_FAILED


def _run(argv: Sequence[str] | None) -> int:
    arguments = _parser().parse_args(argv)
    _set_up_logging(quiet=arguments.quiet)
    _check_place_of_options(arguments)
    match arguments.command:
        case "demo":
            return _demo(arguments)
        case "replay":
            return _replay(arguments)
        case "report":
            return _report(arguments)
    return _fly(arguments)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="companion",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"companion {__version__}")
    parser.add_argument("--connect", metavar="URL", help="link to the autopilot")
    parser.add_argument(
        "--ranging",
        metavar="URL",
        action="append",
        default=[],
        help="link that carries only ranging messages; repeatable",
    )
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
    parser.add_argument(
        "--fresh",
        action="store_true",
        help="take up nothing of an earlier run that did not end in order",
    )
    parser.add_argument("--once", action="store_true", help="end after the target is reported")
    parser.add_argument("--quiet", action="store_true", help="only warnings and errors")
    _add_web(parser)
    commands = parser.add_subparsers(dest="command", metavar="{demo,replay,report}")
    _add_demo(commands)
    _add_replay(commands)
    _add_report(commands)
    return parser


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


def _web_settings(arguments: argparse.Namespace) -> WebSettings | None:
    if arguments.fly_web is None:
        given = [
            f"--web-{name}"
            for name in ("control", "token", "open", "tiles")
            if getattr(arguments, f"web_{name}")
        ]
        if given:
            raise ConfigError(f"{given[0]}: there is no map without --web PORT")
        return None
    return web_settings(
        arguments.fly_web,
        token=arguments.web_token,
        is_control_on=arguments.web_control,
        is_view_open=arguments.web_open,
        tiles=arguments.web_tiles,
    )


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


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"`{text}` is not a whole number from 0 up")
    return int(text)


def _check_place_of_options(arguments: argparse.Namespace) -> None:
    """Refuse options of flying in front of a subcommand, which would not see them."""
    if arguments.command is None:
        return
    given = [
        f"--{name}"
        for name in ("connect", "ranging", "signing-key", "insecure", "fresh", "once")
        if getattr(arguments, name.replace("-", "_")) not in (None, [], False)
    ]
    given += [
        f"--{n}" for n in ("config", "speed", "web") if getattr(arguments, f"fly_{n}") is not None
    ]
    if given:
        word = arguments.command
        raise ConfigError(f"{given[0]} in front of `{word}` has no effect; put options after it")


def _set_up_logging(*, quiet: bool) -> None:
    """Our own loggers only: libraries keep their remarks to themselves."""
    logger = logging.getLogger("companion")
    handler = ConsoleHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(message)s"))
    logger.handlers = [handler]
    logger.setLevel(logging.WARNING if quiet else logging.INFO)
    logger.propagate = False


def _fly(arguments: argparse.Namespace) -> int:
    if arguments.connect is None:
        raise ConfigError("say where the autopilot is: --connect udp:127.0.0.1:14550, or try demo")
    config = load_config(arguments.fly_config)
    if arguments.signing_key is not None:
        config = with_signing_key(config, arguments.signing_key)
    settings = _web_settings(arguments)
    urls = [parse_link_url(text) for text in (arguments.connect, *arguments.ranging)]
    for index, url in enumerate(urls):
        if url in urls[:index]:
            text = (arguments.connect, *arguments.ranging)[index]
            raise ConfigError(f"--ranging {text}: this link is given twice; one of them is enough")
    if not arguments.insecure:
        check_exposure(
            urls,
            has_key=config.link.signing_key_file is not None,
            unsigned_ranging=config.link.unsigned_ranging,
        )
    links = [link_from_url(url) for url in urls]
    clock = Clock(arguments.fly_speed or 1.0)
    views = [] if settings is None else [WebView(settings, config)]
    if settings is not None:
        print(f"live map: {settings.url}", file=sys.stderr)
    endpoint = fly(
        config,
        links,
        clock,
        once=arguments.once,
        is_fresh=arguments.fresh,
        views=views,
        at_end=_report_flight,
    )
    if arguments.once and endpoint.session.result is None:
        print("companion: ended before the target was localised", file=sys.stderr)
        return EXIT_FAILED
    return 0


def _report(arguments: argparse.Namespace) -> int:
    from companion.report.page import write_report

    print(write_report(arguments.flight, arguments.output))
    return 0


def _report_flight(directory: Path) -> None:
    """A report of every flight; of a long one only on request, because the end must be quick."""
    from companion.report.page import is_quick, write_report  # jinja2 only where it is needed

    if not is_quick(directory):
        print(f"companion: make the report with: companion report {directory}", file=sys.stderr)
        return
    try:
        path = write_report(directory)
    except CompanionError as error:
        print(f"companion: no report: {error}", file=sys.stderr)
    else:
        logging.getLogger("companion").info("report: %s", path)


def _replay(arguments: argparse.Namespace) -> int:
    config = None if arguments.config is None else load_config(arguments.config)
    if arguments.json is not None:
        check_writable(arguments.json)
    if arguments.file.suffix.lower() == ".csv":
        if arguments.speed is not None:
            raise ConfigError("--speed: a walk is replayed as fast as it goes; leave it out")
        return _replay_walk(arguments, config or CompanionConfig())
    pace = None if arguments.speed is None else Pace(arguments.speed)
    replay = replay_flight(arguments.file, config, print, pace)
    print(replay.comparison.table())
    print(replay.verdict)
    if arguments.json is not None:
        write_json_atomic(arguments.json, {**replay.comparison.as_json(), "exact": replay.is_exact})
    return EXIT_FAILED if replay.is_failed else 0


def _replay_walk(arguments: argparse.Namespace, config: CompanionConfig) -> int:
    def progress(rows: int) -> None:
        if sys.stderr.isatty():
            print(f"\r{rows} rows", end="", file=sys.stderr, flush=True)

    results = replay_walk(arguments.file, config.estimation, progress)
    if sys.stderr.isatty():
        print("\r", end="", file=sys.stderr)
    print(table(results))
    if arguments.json is not None:
        value = {"file": arguments.file.name, "targets": [r.as_json() for r in results]}
        write_json_atomic(arguments.json, value)
    return 0


def _demo(arguments: argparse.Namespace) -> int:
    from companion.demo.runner import DemoOptions, run_demo

    options = DemoOptions(
        seed=arguments.seed,
        speed=arguments.speed,
        scenario=arguments.scenario,
        autopilot=arguments.autopilot,
        config=arguments.config,
        json=arguments.json,
        plot=None if arguments.no_plot else arguments.plot,
        web=None if arguments.web is None else web_settings(arguments.web, is_control_on=True),
    )
    return 0 if run_demo(options) else EXIT_FAILED
