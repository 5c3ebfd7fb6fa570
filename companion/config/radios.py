"""Radios in a configuration and in `--radio NAME[:OPTIONS]@URL`."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec

from companion.config.loader import parse_value, record_within
from companion.domain import Params
from companion.errors import ConfigError
from companion.link.interface import RadioSettings, RadioSetup
from companion.radios.decoder import radio_kind

Name = Annotated[str, msgspec.Meta(pattern="^[a-z][a-z0-9_]*$")]


class RadioConfig(Params, frozen=True):
    """One radio: its kind, its address, and its settings."""

    name: Name
    """Name as listed by `companion radio list`."""
    url: str | None = None
    """Address of the radio; null: given by `--radio NAME@URL`."""
    settings: dict[str, Any] = msgspec.field(default_factory=dict)
    """Keys of `RadioSettings`; others have the defaults of the radio's kind."""
    options: dict[str, Any] = msgspec.field(default_factory=dict)
    """Options of its format; keys of the decoder's own record."""

    @property
    def has_range_offset(self) -> bool:
        """True if the constant offset of its ranges is configured, even as 0."""
        return "range_offset_m" in self.settings or "offset_steps" in self.options

    def __post_init__(self) -> None:
        record_within(self.settings, RadioSettings, "settings")


def radio_setup(radio: RadioConfig, path: str) -> RadioSetup:
    """Return a radio's setup for a flight, plugins loaded; a `ConfigError` begins with `path`."""
    kind = radio_kind(radio.name)
    settings = {**kind.defaults, **radio.settings}
    try:
        setup = RadioSetup(
            kind,
            record_within(settings, RadioSettings, "settings"),
            record_within(radio.options, kind.decoder.Options, "options"),
            is_uncalibrated=is_uncalibrated(radio),
        )
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from None
    try:
        kind.decoder(setup.options)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise ConfigError(f"{path}: its decoder cannot be created ({reason})") from error
    return setup


def is_uncalibrated(radio: RadioConfig) -> bool:
    """Return True if its ranges have a constant that must be known and is not set, not even to 0.

    A radio that cannot be loaded has none; it is named where it is loaded.
    """
    try:
        needs_offset = radio_kind(radio.name).needs_offset
    except ConfigError:
        return False
    return needs_offset and not radio.has_range_offset


def parse_radio_option(text: str, configured: RadioConfig | None = None) -> RadioConfig:
    """Return the radio of `--radio NAME[:KEY=VALUE,...]@URL`; a `ConfigError` shows the form.

    Keys are those of the settings and of the format's options. Values of `configured`, the record
    of that name in a file, stay where the option does not change them.
    """
    name, parts, url = _split(text.strip())
    if not url or not name:
        raise ConfigError(
            f"--radio {text}: give NAME@URL, for example nlink@/dev/ttyUSB0; "
            "`companion radio list` has the names"
        )
    base = configured or RadioConfig(name=name)
    settings, options = dict(base.settings), dict(base.options)
    texts = _texts_of(name)
    for part in parts:
        key, equals, value = part.partition("=")
        if not equals:
            raise ConfigError(
                f"--radio {text}: `{part}` is not KEY=VALUE; a value with a comma or @ needs "
                "quotes, KEY='VALUE'"
            )
        is_setting = key.partition(".")[0] in RadioSettings.__struct_fields__
        known = value[1:-1] if _QUOTED.fullmatch(value) else value if key in texts else None
        read = parse_value(value, f"--radio {text}: {key}") if known is None else known
        _put(settings if is_setting else options, key, read)
    raw = {"name": name, "url": url, "settings": settings, "options": options}
    try:
        return record_within(raw, RadioConfig, "")
    except ValueError as error:
        raise ConfigError(f"--radio {text}: {str(error).removeprefix('.')}") from None


_QUOTED = re.compile(r"(['\"]).*\1", re.DOTALL)


def _split(text: str) -> tuple[str, list[str], str]:
    """Split `NAME:KEY=VALUE,...@URL` into name, KEY=VALUE pieces and URL; missing parts are empty.

    Pieces end at a comma outside brackets, the last one at `@`. A value in quotes is literal, and
    ends where its quote is followed by a comma, `@` or the end.
    """
    found = re.match("[^:@]*", text)
    name = found[0] if found else ""
    if text[len(name) : len(name) + 1] != ":":
        return name, [], text[len(name) + 1 :]
    pieces, piece, depth, at = [], "", 0, len(name) + 1
    while at < len(text):
        character = text[at]
        if character in "'\"" and piece.endswith("=") and not depth:
            closed = re.compile(rf"{character}(?=[,@]|\Z)").search(text, at + 1)
            end = len(text) if closed is None else closed.end()
            piece, at = piece + text[at:end], end
            continue
        if character in "[{" and "=" in piece:
            depth += 1
        elif character in "]}":
            depth = max(0, depth - 1)
        if character in ",@" and not depth:
            pieces.append(piece)
            piece = ""
            if character == "@":
                return name, [each for each in pieces if each], text[at + 1 :]
        else:
            piece += character
        at += 1
    return name, [each for each in [*pieces, piece] if each], ""


def _texts_of(name: str) -> frozenset[str]:
    """Return the options of a radio that are text, whose values are not parsed."""
    try:
        fields = msgspec.structs.fields(radio_kind(name).decoder.Options)
    except ConfigError:  # reported where the radio is loaded
        return frozenset()
    return frozenset(f.name for f in fields if _bare(f.type) is str)


def _bare(kind: object) -> object:
    """Return the type behind `Annotated`."""
    return getattr(kind, "__origin__", kind) if hasattr(kind, "__metadata__") else kind


def _put(record: dict[str, Any], key: str, value: object) -> None:
    """Set `a.b` in a copy of the mapping at `a`, which may belong to a file."""
    outer, dot, inner = key.partition(".")
    if not dot:
        record[key] = value
        return
    before = record.get(outer)
    record[outer] = {**(before if isinstance(before, Mapping) else {}), inner: value}


def flown_radios(
    configured: Sequence[RadioConfig], options: Sequence[str], file: Path | None = None
) -> tuple[RadioConfig, ...]:
    """Return the radios of a file and of the command line; `ConfigError` if one has no address.

    With `file` they are also checked, and its errors name it. The second option of a name goes to
    the file's second radio of that name, and so on.
    """
    radios = list(configured)
    taken: Counter[str] = Counter()
    for text in options:
        name = re.split("[:@]", text.strip(), maxsplit=1)[0]
        indices = [number for number, radio in enumerate(configured) if radio.name == name]
        if taken[name] < len(indices):
            index = indices[taken[name]]
            radios[index] = parse_radio_option(text, configured[index])
        else:
            radios.append(parse_radio_option(text))
        taken[name] += 1
    for number, radio in enumerate(radios):
        if radio.url is None:
            source = "" if file is None else f"{file}: $."
            raise ConfigError(
                f"{source}radios[{number}].url: is missing; give it, or --radio {radio.name}@URL"
            )
    if file is not None:
        radio_setups(radios, configured, file)
    return tuple(radios)


def replayed_radios(
    flown: Sequence[RadioConfig], other: Sequence[RadioConfig]
) -> tuple[RadioConfig, ...]:
    """Return the radios of the flight, with another configuration's settings for the same names."""
    taken: Counter[str] = Counter()
    radios = []
    for radio in flown:
        same = [each for each in other if each.name == radio.name]
        if taken[radio.name] < len(same):
            radio = msgspec.structs.replace(same[taken[radio.name]], url=radio.url)
        taken[radio.name] += 1
        radios.append(radio)
    return tuple(radios)


def radio_setups(
    radios: Sequence[RadioConfig], configured: Sequence[RadioConfig] = (), file: Path | None = None
) -> tuple[RadioSetup, ...]:
    """Return `radio_setup` of each; an error of one that is as `configured` names that file."""
    setups = []
    for number, radio in enumerate(radios):
        is_of_file = number < len(configured) and radio is configured[number]
        is_of_file = is_of_file and file is not None
        where = f"{f'{file}: $.' if is_of_file else ''}radios[{number}] ({radio.name})"
        try:
            setups.append(radio_setup(radio, where))
        except ConfigError as error:
            if is_of_file and not str(error).startswith(where):
                raise ConfigError(f"{where}: {error}") from None
            raise
    return tuple(setups)
