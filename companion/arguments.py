"""Arguments of the `companion` command and its subcommands, without the subcommands' code."""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Callable
from itertools import takewhile
from pathlib import Path
from typing import Any, Literal, NoReturn, TypeAlias, get_args

from companion import __version__
from companion.errors import ConfigError, meant

AUTOPILOTS = ("px4", "ardupilot")
USUAL_LINK = "serial:/dev/ttyAMA0:921600"
SYSTEM = Path("/etc/companion")
FieldTestName = Literal["turn", "line", "circle", "blocked"]
TEST_NAMES: tuple[FieldTestName, ...] = get_args(FieldTestName)
MAX_SECONDS = 300.0
MAX_SPEED = 50.0
"""Largest speed of the clock: beyond it, a hiccup exceeds the autopilot's time-outs."""

DESCRIPTION = """\
Find a radio emitter with a UAV: estimate it from ranging messages, fly crossings over the
estimate, and report where it is and how wrong that may be.

The vehicle is commanded only in offboard mode (PX4 OFFBOARD, ArduPilot GUIDED), which the
pilot selects by the mode switch and leaves at any time. After two seconds in another mode it
is ready again; after a failsafe you read "grant needed": press GRANT on the live map, or send
component 191 MAV_CMD_NAV_GUIDED_ENABLE (92) with parameter 1 = 1."""

EPILOG = """\
links:
  udp:HOST:PORT, udpin:HOST:PORT   the companion binds HOST:PORT and answers the autopilot;
                                   without HOST 127.0.0.1, beyond it only with a key
  udpout:HOST:PORT                 the companion sends first, the other side binds
  tcp:HOST:PORT, tcpin:HOST:PORT   connect to, or listen at, HOST:PORT
  serial:/dev/ttyAMA0:921600       a serial port and its speed
  Each may be spelt with :// as well, and udp:// is udpin:// .

radios (companion radio list):
  nlink@/dev/ttyUSB0               the usual speed, or NAME@serial:/dev/ttyUSB0:115200
  kraken@192.168.1.10              a page that is polled, or NAME@http://HOST:PORT/PATH
  ndjson@udp:HOST:PORT             tcp:, tcpin: and udpout: as well
  ndjson@exec:COMMAND, @stdin:     what a program prints
  ndjson@file:PATH                 what is added to a file; with ?play=1 it is played back

examples:
  companion --connect udp:127.0.0.1:14540
  companion --connect serial:/dev/ttyAMA0:921600 --ranging udp:127.0.0.1:14600 \\
            --config configs/companion/default.yaml
  companion --connect serial:/dev/ttyAMA0:921600 --radio nlink:bearing_sign=-1@/dev/ttyUSB0
  companion demo --speed 4
  companion replay walk.csv --config configs/companion/wifi_rtt.yaml --json walk.json"""

CALIBRATE = """\
Find a radio's offset, scale, sign, mount, lag and noise from a recording around an emitter at a
known position: a turn, a line, a circle and a blocked run. Prints a verdict, and YAML for the
radio's `settings` and for `estimation.filter`. Exit code 1: refused, with the reason."""


class RaisingParser(argparse.ArgumentParser):
    """Raises instead of printing, so that every error is one line; -35.36 is a value, no option."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._negative_number_matcher = re.compile(r"-\.?\d")

    def error(self, message: str) -> NoReturn:
        """Raise `ConfigError` for wrong arguments."""
        raise ConfigError(f"{message} ({self.prog} --help shows how)")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse; an unknown option is the error, not the word behind it."""
        given = sys.argv[1:] if args is None else list(args)
        commands = {n for a in self._actions if a.nargs == argparse.PARSER for n in a.choices or ()}
        for word in takewhile(lambda word: word != "--" and word not in commands, given):
            name, known = word.partition("=")[0], self._option_string_actions
            if name.startswith("--") and not any(option.startswith(name) for option in known):
                self.error(f"{name}: no such option{meant(name, known, cutoff=0.75)}")
        return super().parse_known_args(given, namespace)

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse a word that is none of an argument's, and name the one that was meant."""
        if action.choices is not None and value not in action.choices:
            words = [str(choice) for choice in action.choices]
            name = "".join(f"{option}: " for option in action.option_strings[:1])
            self.error(f"{name}{value} is none of {', '.join(words)}{meant(str(value), words)}")


Options = argparse._ActionsContainer
Commands: TypeAlias = "argparse._SubParsersAction[RaisingParser]"


def number_in(
    least: float, most: float = math.inf, *, kind: type[float] = float, is_open: bool = False
) -> Callable[[str], float]:
    """Return the type of an argument: a number (int: a whole one) from `least` on."""
    wanted = f"{'above' if is_open else 'from'} {least:g}" + f" to {most:g}" * (most < math.inf)

    def parsed(text: str) -> float:
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not least <= value <= most or (is_open and value == least):
            what = "whole number" if kind is int else "number"
            raise argparse.ArgumentTypeError(f"`{text}` is not a {what} {wanted}")
        return value

    return parsed


_SPEED = number_in(0.0, MAX_SPEED, is_open=True)
_LISTENING_S = number_in(0.0, 86_400.0, is_open=True)


def _port(text: str) -> str:
    if text.rpartition(":")[2].isdecimal():
        return text
    raise ConfigError(f"--web {text}: give a port, or HOST:PORT, for example 8080")


def argument_parser() -> argparse.ArgumentParser:
    """Return the parser of the command; it raises `ConfigError` on wrong arguments."""
    parser = RaisingParser(
        prog="companion",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"companion {__version__}")
    _add_links(parser)
    _add_flight(parser)
    web = parser.add_argument_group("live map (extra web)")
    text = "serve the live map; without HOST to this computer only, beyond it with a token"
    _option(web, "--web", "[HOST:]PORT", text, dest="fly_web")
    _switch(web, "--web-control", "with HOLD, RESUME and RETURN")
    _option(web, "--web-token", "TEXT", "token instead of a random one")
    _switch(web, "--web-open", "viewing needs no token, buttons do")
    _tiles(web, dest="fly_web_tiles")
    commands = parser.add_subparsers(
        dest="command", metavar="{demo,setup,doctor,replay,report,area,radio,tiles,config,warm-up}"
    )
    for add in (_add_demo, _add_replay, _add_report, _add_area, _add_doctor):
        add(commands)
    for add in (_add_radio, _add_config, _add_setup, _add_tiles, _add_warm_up):
        add(commands)
    return parser


def _option(options: Options, name: str, metavar: str, text: str, **more: Any) -> None:
    options.add_argument(name, metavar=metavar, help=text, **more)


def _file(options: Options, name: str, text: str, metavar: str = "FILE", **more: Any) -> None:
    options.add_argument(name, metavar=metavar, help=text, type=Path, **more)


def _switch(options: Options, name: str, text: str, **more: Any) -> None:
    options.add_argument(name, action="store_true", help=text, **more)


def _tiles(options: Options, **more: Any) -> None:
    _file(options, "--web-tiles", "map tiles, z/x/y.png", "DIR", **more)


def _config(options: Options, text: str = "companion configuration", **more: Any) -> None:
    _file(options, "--config", text, **more)


def _radios(options: Options, text: str = "radio as in flight", name: str = "radios") -> None:
    _option(options, "--radio", "RADIO", text, action="append", default=[], dest=name)


def _add_links(parser: Options) -> None:
    repeatable: dict[str, Any] = {"action": "append", "default": []}
    _option(parser, "--connect", "URL", "link to the autopilot")
    text = "link that carries only ranging messages; repeatable"
    _option(parser, "--ranging", "URL", text, **repeatable)
    text = "radio with a format of its own, NAME[:KEY=VALUE,...]@URL; repeatable"
    _radios(parser, text, "radio")
    text = "link to a ground station, besides the route through the autopilot; repeatable"
    _option(parser, "--gcs", "URL", text, **repeatable)
    text = "send found emitters as Cursor on Target over UDP, for ATAK (239.2.3.1:6969)"
    _option(parser, "--cot", "HOST:PORT", text)


def _add_flight(parser: Options) -> None:
    _config(parser, "configuration YAML", dest="fly_config")
    text = "seconds of a simulator per real second (default 1)"
    _option(parser, "--speed", "X", text, dest="fly_speed", type=_SPEED)
    text = "QGroundControl .plan or .kml with the fence, instead of the configuration's"
    _file(parser, "--fence", text)
    text = "MAVLink 2 signing with the key in FILE (64 hexadecimal digits, mode 0600)"
    _file(parser, "--signing-key", text)
    text = "listen beyond this machine even without a key: anyone may then command the vehicle"
    _switch(parser, "--insecure", text)
    _switch(parser, "--fresh", "ignore state saved by an unclean exit")
    _switch(parser, "--once", "end after the target is reported")
    _switch(parser, "--quiet", "only notices, warnings and errors")


def _add_demo(commands: Commands) -> None:
    demo = commands.add_parser(
        "demo",
        help="fly the canonical search on the simulator and watch it",
        description="Start sim-link, fly the canonical search over UDP, and show how well it went.",
    )
    _option(demo, "--seed", "N", "seed of the simulator", type=number_in(0, kind=int), default=1)
    _option(demo, "--speed", "X", "multiple of real time", type=_SPEED, default=1.0)
    text = "scenario for sim-link: a file, or its name in configs/scenarios, for example "
    _file(demo, "--scenario", text + "field/phone_ftm, which brings the preset of that name")
    text = "autopilot to fly (default: the scenario's, px4)"
    demo.add_argument("--autopilot", choices=AUTOPILOTS, help=text)
    _config(demo)
    _file(demo, "--json", "write the result as JSON")
    _file(demo, "--plot", "picture of the track (default track.png)", default=Path("track.png"))
    text = "serve the live map, with buttons (default port 8080), and open the browser"
    _option(demo, "--web", "[HOST:]PORT", text, nargs="?", const="8080", type=_port)
    _tiles(demo)
    _switch(demo, "--no-browser", "open no browser")
    _switch(demo, "--no-plot", "do not draw the track")


def _add_doctor(commands: Commands) -> None:
    doctor = commands.add_parser(
        "doctor",
        help="check autopilot, link, radios and computer before a flight",
        description="Check autopilot, link, radios and computer as a flight needs them, and "
        "suggest a remedy for each problem. Nothing is armed, switched or set. "
        "Exit code 1: do not fly.",
    )
    _option(doctor, "--connect", "URL", "link to the autopilot", dest="link", required=True)
    _radios(doctor, "radio as in flight; listened to, one after the other")
    _config(doctor)
    _file(doctor, "--signing-key", "signing key as in flight", dest="key")
    _switch(doctor, "--insecure", "listen as in flight", dest="is_insecure")
    text, seconds = "seconds for which streams are counted (default 5)", number_in(1.0, MAX_SECONDS)
    _option(doctor, "--seconds", "S", text, type=seconds, default=5.0)
    _switch(doctor, "--json", "print the results as JSON")


def _add_config(commands: Commands) -> None:
    config = commands.add_parser(
        "config",
        help="show every value of a configuration and its origin, or the schema",
        description="Show the values of a configuration, or the schema of its files.",
    )
    parts = config.add_subparsers(dest="config_command", metavar="{show,schema}", required=True)
    show = parts.add_parser(
        "show",
        help="every value, and whether it comes from the defaults, a file or a flag",
        description="Print the configuration that a flight with these arguments would have, as "
        "a file that can be used again, with the origin of each value behind it.",
    )
    _config(show)
    _file(show, "--fence", "fence as in flight", dest="site")
    _file(show, "--signing-key", "signing key as in flight", dest="key")
    _radios(show)
    _switch(show, "--changed", "only values that differ from the defaults")
    _switch(show, "--json", "print a list of path, value, origin")
    parts.add_parser(
        "schema",
        help="print the JSON Schema of configuration files, for editors",
        description="Print the JSON Schema of configuration files, with what each key means.",
    )


def _add_setup(commands: Commands) -> None:
    setup = commands.add_parser(
        "setup",
        help="make this computer ready to fly: configuration, service, doctor, compiling",
        description="Ask what the vehicle has, or take it from the options; write configuration "
        "and service, compile ahead, run the doctor, and list what to set in the autopilot. "
        "Everything is written, or nothing. Exit code 1: written, but the doctor says do not fly.",
    )
    setup.add_argument("--autopilot", choices=AUTOPILOTS, dest="kind", help="the autopilot")
    text = f"link to the autopilot, for example {USUAL_LINK}"
    _option(setup, "--connect", "URL", text, dest="link")
    _option(setup, "--radio", "RADIO", "NAME[:KEY=VALUE,...]@URL, or none", dest="own_radio")
    text = "link that carries only ranging messages"
    _option(setup, "--ranging", "URL", text, dest="own_ranging")
    _option(setup, "--preset", "NAME", "configuration to begin with: a file, or a name in configs")
    text = ".plan or .kml file with the fence, which is copied; or none: 150 m to each side"
    _option(setup, "--fence", "FILE", text, dest="site")
    text = f"folder of the configuration (default: {SYSTEM} for root, else ~/.config/companion)"
    _file(setup, "--directory", text, "DIR")
    text = "write a systemd unit into DIR as well, unless a package brought one"
    _file(setup, "--unit-directory", text, "DIR")
    _option(setup, "--user", "NAME", "user of the service (default: you)")
    _switch(setup, "--no-doctor", "do not run the doctor now")
    _switch(setup, "--no-warm-up", "do not compile now")
    _switch(setup, "--remove", "undo the setup in --directory")


def _add_tiles(commands: Commands) -> None:
    text = "map tiles for the live map, from a server"
    tiles = commands.add_parser("tiles", help=text, description=text)
    parts = tiles.add_subparsers(dest="tiles_command", metavar="{fetch}", required=True)
    fetch = parts.add_parser(
        "fetch",
        help="get the tiles around a position from a server of your choice",
        description="Get the tiles around a position from a server. You are responsible for "
        "complying with its terms of use; many public servers forbid bulk downloads.",
    )
    fetch.add_argument("url", metavar="URL", help="server's address with {z}, {x} and {y}")
    _option(fetch, "--around", "LAT,LON", "centre, degrees", required=True)
    _option(fetch, "--radius", "M", "default 500", type=float, default=500.0)
    _option(fetch, "--zoom", "MIN-MAX", "default 13-17", default="13-17")
    _file(fetch, "folder", "folder for --web-tiles DIR", "DIR")


def _add_warm_up(commands: Commands) -> None:
    warm_up = commands.add_parser(
        "warm-up",
        help="compile the kernels for later flights, if numba is installed",
        description="Compile the kernels for the flights of every configuration, and keep them: "
        "half a minute or more, once. It needs numba, setuptools and a C compiler; without it "
        "kernels run as plain Python, which suffices in flight.",
    )
    _config(warm_up, "companion configuration, which is only checked")


def _add_replay(commands: Commands) -> None:
    replay = commands.add_parser(
        "replay",
        help="run a recorded flight or ranging walk again",
        description="Run a recorded flight through the flight software again and check that the "
        "result is identical, or, with another configuration, show how it differs. "
        "A CSV file is a recorded ranging walk, and what `companion radio record` wrote is "
        "decoded again; both go through the estimator, with one filter per target.",
    )
    replay.add_argument("file", metavar="FLIGHT|FILE.tlog|FILE.csv|RECORDING", type=Path)
    text = "speed of a flight, a multiple of real time (default: as fast as possible)"
    _option(replay, "--speed", "X", text, type=_SPEED)
    text = "show a flight on the live map, at --speed 1 unless given, once a browser has opened it "
    text += "(default port 8080)"
    _option(replay, "--web", "[HOST:]PORT", text, nargs="?", const="8080", type=_port)
    _tiles(replay)
    text = "for a walk: standard deviation of its positions per axis, metres (default: its column "
    text += "own_sigma_m, or that of the .json beside it; 3 if not stated)"
    _option(replay, "--own-sigma", "M", text, type=number_in(0.0, 1e4))
    _switch(replay, "--explain", "for a walk: print the terms that widen each R95")
    _config(replay)
    _file(replay, "--json", "write the results as JSON")


def _add_report(commands: Commands) -> None:
    report = commands.add_parser(
        "report",
        help="make the report of a recorded flight",
        description="Make one self-contained HTML page of a flight's event log, and print where it "
        "is. Every flight gets one at its end.",
    )
    _file(report, "flight", "folder of the flight, or a file in it", "FLIGHT")
    _file(report, "--output", "file to write (default: report.html in the folder)")
    _tiles(report)


def _add_area(commands: Commands) -> None:
    area = commands.add_parser(
        "area",
        help="show what flights have searched, and combine it",
        description="Show the area that flights without contact have searched: in a sentence, or "
        "combined over several flights.",
    )
    parts = area.add_subparsers(dest="area_command", metavar="{show,merge}", required=True)
    text = "print what a flight has searched"
    show = parts.add_parser("show", help=text, description=f"{text.capitalize()}.")
    _file(show, "flight", "folder of the flight", "FLIGHT")
    _switch(show, "--json", "print the figures as JSON")
    text = "combine what flights have searched over the area of the first one"
    merge = parts.add_parser("merge", help=text, description=f"{text.capitalize()}.")
    _file(merge, "flights", "folders of the flights", "FLIGHT", nargs="+")
    text = "folder for the files (default: searched)"
    _file(merge, "--out", text, "DIR", default=Path("searched"))


def _add_radio(commands: Commands) -> None:
    radio = commands.add_parser(
        "radio",
        help="list, watch, record and calibrate radios",
        description="List radios with formats of their own, and watch, record or calibrate them.",
    )
    parts = radio.add_subparsers(
        dest="radio_command", metavar="{list,identify,watch,record,calibrate}", required=True
    )
    parts.add_parser("list", help="every radio that can be chosen, and what it measures")
    identify = parts.add_parser(
        "identify",
        help="listen ten seconds, and print which radio it is and its command",
        description="Listen at an address (a serial port: at its usual speeds) and name the radio.",
    )
    identify.add_argument("url", metavar="@URL", help="address as in NAME@URL")
    _option(identify, "--seconds", "S", "duration in seconds", type=_LISTENING_S, default=10.0)
    watch = parts.add_parser(
        "watch",
        help="show the readings of a radio, live",
        description="Show the readings of radios: rate, range, bearing, scatter, and refusals.",
    )
    watch.add_argument("radios", metavar="RADIO", nargs="*", help="NAME[:KEY=VALUE,...]@URL")
    _add_listening(watch, "duration in seconds (default: until Ctrl-C)")
    record = parts.add_parser(
        "record",
        help="record what radios send, with the vehicle's poses",
        description="Record the bytes of radios with their times and, if connected, the vehicle's "
        "position and attitude. `companion replay FILE` runs the recording through the estimator.",
    )
    record.add_argument("file", metavar="FILE", type=Path)
    _radios(record)
    _option(record, "--connect", "URL", "link to the autopilot", dest="link")
    _add_listening(record, "duration in seconds (default: until Ctrl-C)")
    _add_calibrate(
        parts.add_parser(
            "calibrate",
            help="find offset, scale, sign, mount, lag and noise from a recording around "
            "an emitter at a known position",
            description=CALIBRATE,
        )
    )


def _add_listening(options: Options, text: str) -> None:
    _config(options)
    _option(options, "--seconds", "S", text, type=_LISTENING_S)
    _switch(options, "--insecure", "listen beyond this machine, too", dest="is_insecure")


def _add_calibrate(calibrate: Options) -> None:
    text = "recording of `companion radio record`; with --radio it is written first"
    _file(calibrate, "file", text, nargs="?")
    text = "metres from the antenna to the emitter: find the radio's offset, and keep it"
    _option(calibrate, "--beside", "M", text, type=float)
    text = "a ranging walk as for `companion replay`, with target_x_m and target_y_m"
    _file(calibrate, "--from-csv", text, dest="csv")
    text = "position of the emitter, degrees and metres above mean sea level (default: home's)"
    _option(calibrate, "--point", "LAT,LON[,AMSL]", text)
    text = "the same in metres east, north and up from the autopilot's origin"
    _option(calibrate, "--point-enu", "E,N,U", text)
    _option(calibrate, "--emitter", "ID", "id of the emitter, if there are several")
    text = f"test in FILE, {', '.join(TEST_NAMES)}, and its time, in seconds; repeatable"
    _option(calibrate, "--test", "NAME[@FROM-TO]", text, action="append", default=[], dest="tests")
    _radios(calibrate, "record this radio first, NAME[:KEY=VALUE,...]@URL; repeatable")
    _option(calibrate, "--connect", "URL", "link to the autopilot", dest="link")
    _add_listening(calibrate, "duration in seconds (default: until Ctrl-C)")
    _file(calibrate, "--json", "write all figures as JSON")
