"""The options of `companion config`, `setup` and `tiles`; a flight loads nothing else of them."""

from __future__ import annotations

import argparse
from pathlib import Path

AUTOPILOTS = ("px4", "ardupilot")
LINK = "serial:/dev/ttyAMA0:921600"
SYSTEM = Path("/etc/companion")


def add_config(parser: argparse.ArgumentParser) -> None:
    """Add the options of `companion config`."""
    commands = parser.add_subparsers(dest="config_command", metavar="{show,schema}", required=True)
    show = commands.add_parser(
        "show",
        help="every value, and whether it is a default, of a file or of a flag",
        description="Print the configuration that a flight with these arguments would have, as "
        "a file that can be used again, with the origin of each value behind it.",
    )
    for name, place, words in (
        ("--config", "config", "companion configuration"),
        ("--fence", "site", "as in flight"),
        ("--signing-key", "key", "as in flight"),
    ):
        show.add_argument(name, dest=place, metavar="FILE", type=Path, help=words)
    show.add_argument(
        "--radio", metavar="RADIO", action="append", default=[], dest="radios", help="as in flight"
    )
    show.add_argument("--changed", action="store_true", help="only what is no default")
    show.add_argument("--json", action="store_true", help="print a list of path, value, origin")
    commands.add_parser(
        "schema",
        help="print the JSON Schema of configuration files, for editors",
        description="Print the JSON Schema of configuration files, with what each key means.",
    )


def add_setup(parser: argparse.ArgumentParser) -> None:
    """Add the options of `companion setup`."""
    parser.add_argument("--autopilot", choices=AUTOPILOTS, dest="kind", help="which one flies")
    for name, place, metavar, text in (
        ("--connect", "link", "URL", f"link to the autopilot, for example {LINK}"),
        ("--radio", "own_radio", "RADIO", "NAME[:KEY=VALUE,...]@URL, or none"),
        ("--ranging", "own_ranging", "URL", "link that carries only ranging messages"),
        ("--preset", "preset", "NAME", "what to begin with: a file, or a name in configs"),
    ):
        parser.add_argument(name, dest=place, metavar=metavar, help=text)
    text = ".plan or .kml file with the fence, which is copied; or none: 150 m to each side"
    parser.add_argument("--fence", dest="site", metavar="FILE", help=text)
    text = f"where the configuration goes (default: {SYSTEM} for root, else ~/.config/companion)"
    parser.add_argument("--directory", metavar="DIR", type=Path, help=text)
    text = "write a systemd unit into DIR as well, unless a package brought one"
    parser.add_argument("--unit-directory", metavar="DIR", type=Path, help=text)
    parser.add_argument("--user", metavar="NAME", help="who runs the service (default: you)")
    parser.add_argument("--no-doctor", action="store_true", help="do not look at the autopilot now")
    parser.add_argument("--no-warm-up", action="store_true", help="do not compile now")
    parser.add_argument("--remove", action="store_true", help="undo the setup in --directory")


def add_tiles(parser: argparse.ArgumentParser) -> None:
    """Add the options of `companion tiles`."""
    commands = parser.add_subparsers(dest="tiles_command", metavar="{fetch}", required=True)
    fetch = commands.add_parser(
        "fetch",
        help="get the tiles about a place from a server that you name",
        description="Get the tiles about a place from a server. You name it, so its terms of use "
        "are yours to keep; many public servers forbid fetching ahead.",
    )
    fetch.add_argument("url", metavar="URL", help="with {z}, {x} and {y} in it")
    fetch.add_argument("--around", metavar="LAT,LON", required=True, help="centre, degrees")
    fetch.add_argument("--radius", metavar="M", type=float, default=500.0, help="default 500")
    fetch.add_argument("--zoom", metavar="MIN-MAX", default="13-17", help="default 13-17")
    fetch.add_argument("folder", metavar="DIR", type=Path, help="for --web-tiles DIR")
