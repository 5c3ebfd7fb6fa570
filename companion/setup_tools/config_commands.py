"""The commands `companion config` and `companion tiles`.

The first shows each value with its origin, and the schema for editors; the second fills a folder
with map tiles for the live map from a server.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import itertools
import json
import math
import re
import sys
import textwrap
import time
import urllib.request
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import yaml

from companion import __version__
from companion.config.loader import parse_value, read_text
from companion.config.radios import radio_setups
from companion.config.schema import (
    CompanionConfig,
    load_config,
    with_fence,
    with_radios,
    with_signing_key,
)
from companion.config.versions import KEY, is_in, renew
from companion.errors import CompanionError, ConfigError
from companion.geometry.coordinates import LATITUDES_DEG, tile_at
from companion.link.interface import RadioSettings
from companion.web.settings import IMAGE_KINDS, MAX_TILE_BYTES, tile_path

DEFAULT = "default"
WIDTH = 44
"""Column of the origins."""
DIALECT = "https://json-schema.org/draft/2020-12/schema"


@dataclass(frozen=True, slots=True)
class Shown:
    """A value, its path with dots, and its origin."""

    path: str
    value: object
    origin: str


def shown_values(file: Path | None, steps: Sequence[tuple[str, CompanionConfig]]) -> list[Shown]:
    """Return every value of the last configuration, in the order of the schema.

    `steps` are pairs of an origin and the configuration after it: first the file (or nothing), then
    each flag.
    """
    written = {} if file is None else _written(file)
    origins: dict[str, str] = {}
    values: dict[str, object] = {}
    for number, (origin, config) in enumerate(steps):
        for path, value in _leaves(config, ""):
            if number == 0:
                origins[path] = origin if is_in(written, path) else DEFAULT
            elif value != values[path]:
                origins[path] = origin
            values[path] = value
    return [Shown(path, values[path], origins[path]) for path in values]


def as_yaml(values: Sequence[Shown]) -> list[str]:
    """Return the values as lines of a configuration file, with origins as remarks."""
    lines: list[str] = []
    open_sections: list[str] = []
    for shown in values:
        *sections, key = shown.path.split(".")
        pairs = zip(sections, open_sections, strict=False)
        same = sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], pairs))
        lines += [f"{'  ' * n}{sections[n]}:" for n in range(same, len(sections))]
        open_sections = sections
        line = f"{'  ' * len(sections)}{key}: {_flow(shown.value)}"
        lines.append(f"{line:<{WIDTH}}  # {shown.origin}")
    return lines


def as_json(values: Sequence[Shown]) -> list[dict[str, object]]:
    """Return the values for programs."""
    return [
        {"path": each.path, "value": msgspec.to_builtins(each.value), "origin": each.origin}
        for each in values
    ]


def notes_of(file: Path | None) -> list[str]:
    """Return remarks about keys of a file that an earlier schema had and that have no effect."""
    raw = {} if file is None else parse_value(read_text(file), str(file))
    dropped = renew(raw, str(file)) if isinstance(raw, dict) else []
    return [f"# $.{path} was removed in schema 2: delete it" for path in dropped]


def json_schema() -> str:
    """Return the JSON Schema of a configuration file, with the meaning of each key."""
    kinds = (CompanionConfig, RadioSettings)
    (whole, settings), records = msgspec.json.schema_components(
        kinds, ref_template="#/$defs/{name}"
    )
    records["RadioConfig"]["properties"]["settings"] = settings
    remarks = dict(_remarks(CompanionConfig)) | dict(_remarks(RadioSettings))
    for record, name in remarks:
        properties = records[record]["properties"]
        if name in properties:  # others are fixed, and no keys
            properties[name] = {**properties[name], "description": remarks[record, name]}
    head = {"$schema": DIALECT, "title": "companion-guidance configuration"}
    return json.dumps({**head, **whole, "$defs": records}, indent=2)


def _written(file: Path) -> dict[str, Any]:
    raw = parse_value(read_text(file), str(file))
    if not isinstance(raw, dict):
        return {}
    has_version = KEY in raw
    renew(raw, str(file))
    if not has_version:
        del raw[KEY]
    return raw


def _leaves(record: object, path: str) -> Iterator[tuple[str, object]]:
    """Yield the values of a record that are not records themselves, with their paths."""
    names = getattr(record, "__struct_fields__", ())
    keys = getattr(record, "__struct_encode_fields__", ())
    for name, key in zip(names, keys, strict=True):
        value, key_path = getattr(record, name), f"{path}{key}"
        if isinstance(value, msgspec.Struct):
            yield from _leaves(value, f"{key_path}.")
        else:
            yield key_path, value


def _flow(value: object) -> str:
    plain = msgspec.to_builtins(value)
    text = yaml.safe_dump(plain, default_flow_style=True, width=10_000, sort_keys=False)
    return text.removesuffix("\n").removesuffix("\n...")


def _remarks(kind: type[msgspec.Struct]) -> Iterator[tuple[tuple[str, str], str]]:
    """Yield the docstrings of the fields of a record and of records in it, by their names."""
    seen: set[type] = set()
    waiting: list[Any] = [msgspec.inspect.type_info(kind)]
    while waiting:
        info = waiting.pop()
        if isinstance(info, msgspec.inspect.StructType):
            if info.cls in seen:
                continue
            seen.add(info.cls)
            waiting += [each.type for each in info.fields]
            for name, text in _field_remarks(info.cls):
                yield (info.cls.__name__, name), text
        elif isinstance(info, msgspec.inspect.UnionType):
            waiting += info.types
        elif isinstance(info, msgspec.inspect.VarTupleType):
            waiting.append(info.item_type)


def _field_remarks(cls: type) -> Iterator[tuple[str, str]]:
    """Yield the docstrings of the fields of a class, from its source, without inherited ones."""
    try:
        (body,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
    except (OSError, TypeError):  # a package without its sources
        return
    statements = body.body if isinstance(body, ast.ClassDef) else []
    for before, after in itertools.pairwise(statements):
        if (
            isinstance(before, ast.AnnAssign)
            and isinstance(before.target, ast.Name)
            and isinstance(after, ast.Expr)
            and isinstance(after.value, ast.Constant)
        ):
            yield before.target.id, " ".join(str(after.value.value).split())


def run(arguments: argparse.Namespace) -> int:
    """Run the command; return the exit code."""
    if arguments.config_command == "schema":
        _say(json_schema())
        return 0
    config = load_config(arguments.config)
    steps = [(str(arguments.config), config)]
    if arguments.site is not None:
        config = with_fence(config, arguments.site)
        steps.append((f"--fence {arguments.site}", config))
    if arguments.key is not None:
        config = with_signing_key(config, arguments.key)
        steps.append((f"--signing-key {arguments.key}", config))
    for radio in arguments.radios:
        config = with_radios(config, [radio])
        steps.append((f"--radio {radio}", config))
    radio_setups(config.radios, steps[0][1].radios, arguments.config)  # what a flight refuses
    values = shown_values(arguments.config, steps)
    if arguments.changed:
        values = [each for each in values if each.origin != DEFAULT]
    if arguments.json:
        _say(json.dumps(as_json(values), indent=2))
    else:
        _say("\n".join([*notes_of(arguments.config), *as_yaml(values)]))
    return 0


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n" if text else "")


MAX_TILES = 20_000
"""Maximum number of tiles of one fetch; more is a burden to a server that others pay for."""
PAUSE_S = 0.05
TIMEOUT_S = 20.0
METRES_PER_DEGREE = 111_319.5
Position = tuple[int, int, int]
"""Zoom, x and y of a tile."""


def run_tiles(arguments: argparse.Namespace) -> int:
    """Fetch missing tiles, and return the exit code."""
    tiles = wanted_tiles(arguments.around, arguments.radius, arguments.zoom)
    if not arguments.url.startswith(("http://", "https://")):
        raise ConfigError(f"{arguments.url}: must begin with http:// or https://")
    if not all(part in arguments.url for part in ("{z}", "{x}", "{y}")):
        raise ConfigError(f"{arguments.url}: must have {{z}}, {{x}} and {{y}} in it")
    url = arguments.url
    missing = [each for each in tiles if not tile_path(arguments.folder, *each).exists()]
    count, folder = _stored(_fetched(url, missing), arguments.folder), arguments.folder
    sys.stdout.write(f"{count} tiles in {folder}; show them with: --web-tiles {folder}\n")
    return 0


def wanted_tiles(around: str, radius_m: float, zooms: str) -> list[Position]:
    """Return zoom, x and y of every tile that a square around a point touches."""
    try:
        latitude_deg, longitude_deg = map(float, around.split(","))
    except ValueError:
        raise ConfigError(f"--around {around}: give LAT,LON in degrees, as in 47.4,8.55") from None
    if not (abs(latitude_deg) <= LATITUDES_DEG and abs(longitude_deg) <= 180.0):
        raise ConfigError(f"--around {around}: no such position on a map of tiles")

    match = re.fullmatch(r"(\d+)(?:-(\d+))?", zooms)
    least = int(match[1]) if match else -1
    most = int(match[2] or match[1]) if match else -1
    if not 0 <= least <= most <= 22:
        raise ConfigError(f"--zoom {zooms}: give MIN-MAX between 0 and 22, as in 13-17")

    if not 0.0 < radius_m <= 100_000.0:
        raise ConfigError(f"--radius {radius_m:g}: give metres, up to 100000")
    north_deg = radius_m / METRES_PER_DEGREE
    east_deg = north_deg / math.cos(math.radians(latitude_deg))
    wanted: list[Position] = []
    for zoom in range(least, most + 1):
        left, top = tile_at((latitude_deg + north_deg, longitude_deg - east_deg), zoom)
        right, bottom = tile_at((latitude_deg - north_deg, longitude_deg + east_deg), zoom)
        if len(wanted) + (right - left + 1) * (bottom - top + 1) > MAX_TILES:
            raise ConfigError(
                f"--zoom {zooms}: more than {MAX_TILES} tiles; choose a smaller --radius or zoom"
            )
        wanted += [(zoom, x, y) for x in range(left, right + 1) for y in range(top, bottom + 1)]
    return wanted


def _fetched(url: str, tiles: Iterable[Position]) -> Iterator[tuple[Position, bytes]]:
    """Yield tiles one by one, with pauses; those before a failure are kept by the caller."""
    for zoom, x, y in tiles:
        address = url.replace("{z}", str(zoom)).replace("{x}", str(x)).replace("{y}", str(y))
        agent = {"User-Agent": f"companion-guidance/{__version__}"}
        try:
            request = urllib.request.Request(address, headers=agent)
            with urllib.request.urlopen(request, timeout=TIMEOUT_S) as answer:
                picture = answer.read(MAX_TILE_BYTES + 1)
        except (OSError, ValueError) as error:
            reason = getattr(error, "reason", None) or error
            raise CompanionError(
                f"{address}: {reason}; tiles so far are kept; run it again to continue"
            ) from error
        if len(picture) > MAX_TILE_BYTES:
            text = f"more than {MAX_TILE_BYTES} bytes, which is not a map tile"
            raise CompanionError(f"{address}: {text}")
        yield (zoom, x, y), picture
        time.sleep(PAUSE_S)


def _stored(tiles: Iterable[tuple[Position, bytes]], folder: Path) -> int:
    """Write tiles as `z/x/y.png` regardless of their image format; return their number."""
    count = 0
    for position, picture in tiles:
        if not picture.startswith(tuple(IMAGE_KINDS)):
            raise CompanionError(f"tile {'/'.join(map(str, position))}: is not an image")
        file = tile_path(folder, *position)
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            part = file.with_suffix(".part")
            part.write_bytes(picture)
            part.replace(file)
        except OSError as error:
            raise CompanionError(f"{file}: cannot be written ({error.strerror})") from error
        count += 1
    return count
