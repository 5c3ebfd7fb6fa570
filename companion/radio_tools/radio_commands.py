"""The commands of `companion radio`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace

import msgspec

from companion.config.radios import radio_setups
from companion.config.schema import CompanionConfig, load_config, with_radios
from companion.errors import ConfigError
from companion.flight_setup import radio_links, with_kept_offsets
from companion.io.links.transports import check_exposure, parse_flight_link
from companion.io.shell import Clock, Shell
from companion.link.interface import LinkRole
from companion.radio_tools import calibrate
from companion.radio_tools.identify import identify
from companion.radio_tools.recorder import record_radios
from companion.radio_tools.watching import WatchingEndpoint
from companion.radios.catalogue import known_radios, radio_kind


def run(arguments: argparse.Namespace) -> int:
    """Run a command; return the exit code."""
    commands: dict[str, Callable[[argparse.Namespace], int]] = {
        "list": _list,
        "identify": _identify,
        "watch": _watch,
        "record": _record,
        "calibrate": calibrate.run,
    }
    return commands[arguments.radio_command](arguments)


def _list(arguments: argparse.Namespace) -> int:
    del arguments
    rows = [("name", "gives", "emitter must carry", "transport", "what")]
    broken = []
    for name, origin in known_radios().items():
        try:
            kind = radio_kind(name)
        except ConfigError as error:
            broken.append(str(error))
            continue
        title = kind.title if origin == "built in" else f"{kind.title} (from {origin})"
        rows.append((name, kind.gives, kind.emitter, kind.transport, title))
    widths = [max(len(row[column]) for row in rows) for column in range(4)]
    for row in rows:
        cells = [f"{cell:<{width}}" for cell, width in zip(row[:4], widths, strict=True)]
        print("  ".join([*cells, row[4]]).rstrip())
    for problem in broken:
        print(f"broken: {problem}")
    return 0


def _identify(arguments: argparse.Namespace) -> int:
    code, text = identify(arguments.url.removeprefix("@"), arguments.seconds)
    print(text, file=sys.stderr if code else sys.stdout)
    return code


def _radios_of(arguments: argparse.Namespace) -> CompanionConfig:
    """Return the configuration with at least one radio, none of them on the network."""
    config = with_kept_offsets(with_radios(load_config(arguments.config), arguments.radios))
    if not config.radios:
        raise ConfigError("name a radio, for example nlink@/dev/ttyUSB0, or a --config with radios")
    if not arguments.is_insecure:
        check_exposure(radio_links(config.radios), has_key=False)
    return config


def _watch(arguments: argparse.Namespace) -> int:
    config = _radios_of(arguments)
    names = [f"{radio.name}@{radio.url}" for radio in config.radios]
    links = radio_links(config.radios)
    setups = [
        replace(setup, settings=msgspec.structs.replace(setup.settings, rate_max_hz=None))
        for setup in radio_setups(config.radios)
    ]
    show = _redraw if sys.stdout.isatty() else _print_lines
    endpoint = WatchingEndpoint(setups, names, show, arguments.seconds)
    Shell(endpoint, [link.transport for link in links], Clock()).run_blocking()
    return 0 if any(stage.measured for stage in endpoint.stages) else 1


def _print_lines(lines: list[str]) -> None:
    print("\n".join(lines), flush=True)


def _redraw(lines: list[str]) -> None:
    """Print lines from the top of the terminal, and clear what is below."""
    print("\x1b[H\x1b[J" + "\n".join(lines), flush=True)


def _record(arguments: argparse.Namespace) -> int:
    config = _radios_of(arguments)
    vehicle = None
    if arguments.link is not None:
        vehicle = parse_flight_link(arguments.link, LinkRole.VEHICLE)
        if not arguments.is_insecure:
            check_exposure([vehicle], has_key=config.link.signing_key_file is not None)
    print(f"recording to {arguments.file}; Ctrl-C ends it", file=sys.stderr)
    recorded = record_radios(arguments.file, config, vehicle, arguments.seconds)
    print(f"{arguments.file}: {recorded.bytes} bytes of radios, {recorded.poses} poses")
    return 0 if recorded.bytes else 1
