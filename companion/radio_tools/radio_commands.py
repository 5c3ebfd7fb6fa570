"""The commands of `companion radio`.

The scatter that `watch` shows excludes the motion: it is estimated from differences of consecutive
values, and robustly, because a few of them are far off without line of sight.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import msgspec

from companion.config.radios import radio_setups
from companion.config.schema import CompanionConfig, load_config, with_radios
from companion.domain import RangingMeasurement
from companion.errors import ConfigError
from companion.flight_setup import radio_links, with_kept_offsets
from companion.geometry.coordinates import bearing_ned_from_enu, wrap_pi
from companion.io.links.transports import check_exposure, parse_flight_link
from companion.io.shell import Clock, Shell
from companion.link.intake import FloodBudget
from companion.link.interface import LinkRole, RadioSetup
from companion.link.quality import RadioWatch
from companion.link.radio_stage import RadioStage
from companion.mav.endpoint import Chunk, OneShotEndpoint
from companion.radio_tools import calibrate
from companion.radio_tools.identify import identify
from companion.radio_tools.recorder import record_radios
from companion.radios.decoder import known_radios, radio_kind

LINE_S = 1.0
KEPT = 50
"""Measurements of an emitter that its scatter is of."""
MAX_SHOWN = 12
"""Emitters of a radio that get a line."""

Show = Callable[[list[str]], None]


class EmitterView:
    """Last measurements of one emitter."""

    def __init__(self) -> None:
        self._kept: deque[tuple[float, RangingMeasurement]] = deque(maxlen=KEPT)

    def add(self, measurement: RangingMeasurement, now_s: float) -> None:
        """Add a measurement."""
        self._kept.append((now_s, measurement))

    def line(self, emitter_id: int, now_s: float) -> str:
        """Return the newest values, their rate and their scatter."""
        newest = self._kept[-1][1]
        recent = sum(now_s - time_s <= 5.0 for time_s, _ in self._kept)
        first_s = max(now_s - 5.0, self._kept[0][0])
        rate_hz = recent / max(now_s - first_s, LINE_S)
        parts = [f"  emitter {emitter_id:<5}", f"{rate_hz:5.1f} Hz"]
        if newest.range_m is not None:
            scatter = scatter_of([m.range_m for _, m in self._kept])
            parts.append(f"range {newest.range_m:8.2f} m{_sigma(scatter, newest.range_sigma_m)}")
        bearing_rad, frame = newest.bearing_body_rad, "from the nose"
        if newest.bearing_enu_rad is not None:
            bearing_rad, frame = bearing_ned_from_enu(newest.bearing_enu_rad), "from north"
        if newest.is_array_angle:
            frame = "of the array"
        if bearing_rad is not None:
            pairs = [(m.bearing_body_rad, m.bearing_enu_rad) for _, m in self._kept]
            scatter = scatter_of([b if e is None else e for b, e in pairs], is_angle=True)
            said = _degrees(newest.bearing_sigma_rad)
            parts.append(
                f"bearing {math.degrees(bearing_rad):+7.1f} deg {frame}"
                f"{_sigma(_degrees(scatter), said)}"
            )
        if newest.elevation_rad is not None:
            parts.append(f"elevation {math.degrees(newest.elevation_rad):+6.1f} deg")
        if newest.power_dbm is not None:
            scatter = scatter_of([m.power_dbm for _, m in self._kept])
            parts.append(f"power {newest.power_dbm:6.1f} dBm{_sigma(scatter, None)}")
        if newest.quality is not None:
            parts.append(f"quality {100.0 * newest.quality:.0f}")
        if newest.line_of_sight is not None:
            parts.append("in sight" if newest.line_of_sight else "not in sight")
        return "  ".join(parts)


def scatter_of(values: Sequence[float | None], *, is_angle: bool = False) -> float | None:
    """Return the standard deviation of consecutive values; None if there are too few."""
    known = [value for value in values if value is not None]
    steps = [after - before for before, after in pairwise(known)]
    if is_angle:
        steps = [wrap_pi(step) for step in steps]
    if len(steps) < 5:
        return None
    return calibrate.robust_sigma(steps) / math.sqrt(2.0)


def _strongest(powers_dbm: Mapping[str, float | None]) -> list[str]:
    """Return the names that were received most strongly, with their power."""
    known = {name: -math.inf if dbm is None else dbm for name, dbm in powers_dbm.items()}
    names = sorted(known, key=lambda name: -known[name])[:MAX_SHOWN]
    return [n if math.isinf(known[n]) else f"{n} ({known[n]:.0f} dBm)" for n in names]


def _degrees(radians: float | None) -> float | None:
    return None if radians is None else math.degrees(radians)


def _sigma(seen: float | None, said: float | None) -> str:
    words = [] if seen is None else [f"scatter {seen:.2f}"]
    words += [] if said is None else [f"says {said:.2f}"]
    return f" ({', '.join(words)})" if words else ""


class WatchingEndpoint(OneShotEndpoint):
    """Shows lines once a second; sends nothing but the links' greetings."""

    def __init__(
        self, setups: Sequence[RadioSetup], names: Sequence[str], show: Show, end_s: float | None
    ) -> None:
        super().__init__(end_s)
        self.stages = [RadioStage(setup) for setup in setups]
        self._watches = [RadioWatch(stage) for stage in self.stages]
        self._budgets = [FloodBudget() for _ in setups]
        self._emitters: list[dict[int, EmitterView]] = [{} for _ in setups]
        self._names = names
        self._show = show
        self._news: deque[str] = deque(maxlen=5)
        self._next_line_s = LINE_S

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Decode received bytes as a flight would."""
        super().receive(chunk, now_s)
        if not self._budgets[chunk.link].spend_raw(len(chunk.data)):
            return
        emitters = self._emitters[chunk.link]
        for measurement in self.stages[chunk.link].receive(chunk.data, now_s):
            view = emitters.setdefault(measurement.emitter_id, EmitterView())
            view.add(measurement, now_s)

    def handle_timer(self, now_s: float) -> None:
        """Show the lines that are due."""
        super().handle_timer(now_s)
        for watch, budget in zip(self._watches, self._budgets, strict=True):
            budget.renew()
            self._news += [news.text for news in watch.tick(now_s)]
        if now_s >= self._next_line_s:
            self._next_line_s += LINE_S * max(1, math.ceil((now_s - self._next_line_s) / LINE_S))
            self._show(self._lines(now_s))

    def _lines(self, now_s: float) -> list[str]:
        lines = [f"{now_s:7.1f} s  {text}" for text in self._news]
        self._news.clear()
        for number, watch in enumerate(self._watches):
            status, dropped = watch.status(now_s), self._budgets[number].dropped_unread
            parts = [self._names[number], f"{status.rate_hz:.1f} Hz"]
            if status.silent_s is None:
                parts.append("nothing heard yet")
            else:
                parts.append(f"{self.stages[number].received} bytes, {status.silent_s:.1f} s ago")
            if status.age_s is not None:
                parts.append(f"delay {1e3 * status.age_s:.0f} ms")
            if self.stages[number].setup.is_uncalibrated:
                parts.append("uncalibrated: range offset unknown")
            if dropped:
                parts.append(f"flood: {dropped} pieces dropped")
            refused = ", ".join(f"{reason} {count}" for reason, count in status.refused.items())
            parts.append(f"refused: {refused}" if refused else "none refused")
            parts += [status.unrecognised] if status.unrecognised else []
            lines.append("  ".join(parts))
            shown = sorted(self._emitters[number].items())[:MAX_SHOWN]
            lines += [view.line(emitter_id, now_s) for emitter_id, view in shown]
            if unlisted := self.stages[number].unlisted:
                lines.append(f"  not in `emitters`: {', '.join(_strongest(unlisted))}")
        return lines


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
    config = with_radios(load_config(arguments.config), arguments.radios, arguments.config)
    config = with_kept_offsets(config)
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
    """Print lines from the top of the terminal, and clear the rest."""
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
