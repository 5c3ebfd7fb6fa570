"""`companion setup`: asks for the vehicle's equipment, or takes it from flags, and sets it up.

Sources of the autopilot's settings: the parameter references of PX4 1.15 and ArduCopter 4.5,
docs/px4.md and docs/ardupilot.md. `companion doctor` reads the values back and explains them.

Files are written or removed all together, or none of them. Every file is made and checked in a
folder of its own, and then moved into its place. An earlier file there is kept next to it, under
its name and `.before-setup`, and is restored by `--remove`. `setup.json` lists the written files,
with checksums, so that no file is deleted that was changed since.
"""

from __future__ import annotations

import argparse
import getpass
import hashlib
import os
import re
import shlex
import shutil
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import yaml

from companion import kernel_cache
from companion.arguments import AUTOPILOTS, SYSTEM, USUAL_LINK
from companion.config.area_files import MAX_BYTES as FENCE_BYTES
from companion.config.area_files import read_fence
from companion.config.loader import parse_value, preset_named, preset_names, read_text, shipped_file
from companion.config.radios import parse_radio_option
from companion.config.schema import CompanionConfig, load_config
from companion.config.versions import KEY, SCHEMA_VERSION, renew
from companion.doctor.examination import exit_code, run_doctor
from companion.doctor.findings import CheckResult, as_lines, fail
from companion.errors import CompanionError, ConfigError, decoding_problem
from companion.flight_setup import flight_links
from companion.io.files import read_bytes, read_file, write_bytes_atomic
from companion.io.links.transports import SerialPort, Transport, check_exposure
from companion.run import compile_kernels

CONFIG, SERVICE_OPTIONS, UNIT = "companion.yaml", "service.env", "companion.service"
RECORD = "setup.json"
BEFORE = ".before-setup"


class SetupRecord(msgspec.Struct, frozen=True):
    """Files of one setup: absolute paths to the SHA-256 of their contents."""

    files: dict[str, str]


def check_files(contents: Mapping[str, bytes]) -> CompanionConfig:
    """Load the configuration as a flight would; `contents` by names in its folder."""
    with tempfile.TemporaryDirectory() as temporary:
        for name, content in contents.items():
            (Path(temporary) / name).write_bytes(content)
        try:
            return load_config(Path(temporary) / CONFIG)
        except ConfigError as error:
            raise ConfigError(str(error).replace(f"{temporary}/", "")) from None


def write_files(directory: Path, contents: Mapping[Path, bytes]) -> None:
    """Write the files and their record; if one cannot be written, restore the previous state."""
    record = _record(directory)
    files = {} if record is None else dict(record.files)
    earlier: dict[Path, bytes | None] = {}
    kept: list[Path] = []
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for path, content in contents.items():
            earlier[path] = read_file(path) if path.exists() else None
            kept += _keep_what_was_there(path, files)
            write_bytes_atomic(path, content)
            files[str(path.absolute())] = _sum(content)
        text = msgspec.json.format(msgspec.json.encode(SetupRecord(files)), indent=2)
        write_bytes_atomic(directory / RECORD, text + b"\n")
    except BaseException as error:  # an interrupt, too
        _undo(earlier, kept)
        if not isinstance(error, OSError):
            raise
        raise CompanionError(f"{directory}: cannot be created ({error.strerror})") from error


def _undo(earlier: Mapping[Path, bytes | None], kept: Sequence[Path]) -> None:
    """Restore the files that a failed setup had replaced."""
    for path, content in earlier.items():
        if content is None:
            path.unlink(missing_ok=True)
        elif read_file(path) != content:
            write_bytes_atomic(path, content)
    for path in kept:
        path.unlink(missing_ok=True)


def remove_files(directory: Path) -> list[str]:
    """Undo a setup; return a line for each file. Raise `ConfigError` if there was none."""
    record = _record(directory)
    if record is None:
        raise ConfigError(f"{directory}: no setup was made here ({RECORD} is missing)")
    lines = []
    for path in (*map(Path, record.files), directory / RECORD):
        if not os.access(path.parent, os.W_OK):
            raise CompanionError(
                f"{path}: cannot be removed; run it as the owner of the folder, or with sudo"
            )
    for name, checksum in record.files.items():
        path = Path(name)
        if path.exists() and _sum(read_file(path)) != checksum:
            lines.append(f"kept: {path}, which was changed since; delete it yourself")
            continue
        is_back = _put_back(path)
        lines.append(f"{'as before the setup' if is_back else 'removed'}: {path}")
    (directory / RECORD).unlink()
    return lines


def _record(directory: Path) -> SetupRecord | None:
    path = directory / RECORD
    try:
        return msgspec.json.decode(read_bytes(path), type=SetupRecord)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(
            f"{path}: is not what a setup wrote ({decoding_problem(error)})"
        ) from None


def _keep_what_was_there(path: Path, files: Mapping[str, str]) -> list[Path]:
    """Keep a file that no setup wrote, or that was changed since, next to it; return its copies."""
    if not path.exists() or files.get(str(path.absolute())) == _sum(read_file(path)):
        return []
    before = path.with_name(path.name + BEFORE)
    shutil.copy2(path, before)
    return [before]


def _put_back(path: Path) -> bool:
    """Delete a file, or restore the earlier one; return True if there was one."""
    before = path.with_name(path.name + BEFORE)
    if before.exists():
        before.replace(path)
        return True
    path.unlink(missing_ok=True)
    return False


def _sum(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


Setting = tuple[str, str, str]
"""Name, value, reason."""


def settings_to_make(autopilot: str, link: Transport, config: CompanionConfig) -> list[Setting]:
    """Return the parameters of one vehicle, in the order in which they are set."""
    baud = link.baud if isinstance(link, SerialPort) else None
    speed_mps = config.limits.speed_mps
    if autopilot == "px4":
        port: list[Setting] = [
            ("MAV_1_CONFIG", "102", "MAVLink on TELEM 2; restart, then the next two appear"),
            ("MAV_1_MODE", "2", "the streams of a companion (Onboard)"),
            ("SER_TEL2_BAUD", f"{baud}", "the speed of the serial port"),
        ]
        return [
            *(port if baud is not None else []),
            ("COM_OF_LOSS_T", "1.0", "seconds without setpoints that end OFFBOARD"),
            ("COM_OBL_RC_ACT", "5", "then Hold; 0 sinks where there is no transmitter"),
            ("GF_ACTION", "2", "PX4's own geofence holds, as the last resort"),
            ("MPC_XY_VEL_MAX", f"{speed_mps:g}", "m/s, or more: limits.speed_mps"),
        ]
    port = [
        ("SERIAL2_PROTOCOL", "2", "MAVLink 2 on TELEM 2"),
        ("SERIAL2_BAUD", f"{0 if baud is None else baud // 1000}", "the speed of the serial port"),
    ]
    return [
        *(port if baud is not None else []),
        ("FS_GCS_ENABLE", "1", "a lost ground station brings the vehicle home"),
        ("SYSID_MYGCS", "255", "the id of your ground station; from 4.7 on MAV_GCS_SYSID"),
        ("FENCE_ENABLE", "1", "ArduPilot's own fence, as the last resort"),
        ("FENCE_ACTION", "4", "it brakes; 1 returns"),
        ("WPNAV_SPEED", f"{100.0 * speed_mps:g}", "cm/s, or more; from 4.7 on WP_SPD, in m/s"),
    ]


def guide(autopilot: str, link: Transport, config: CompanionConfig) -> list[str]:
    """Return the settings as lines for people."""
    name = {"px4": "PX4", "ardupilot": "ArduPilot"}[autopilot]
    rows = settings_to_make(autopilot, link, config)
    width = max(len(row[0]) for row in rows)
    return [
        f"set in {name} (QGroundControl or Mission Planner, Parameters):",
        *(f"  {key:<{width}}  {value:<6}  {why}" for key, value, why in rows),
    ]


SYSTEM_UNITS = (Path("/lib/systemd/system"), Path("/usr/lib/systemd/system"))
"""Folders of packaged units, which read `service.env` of `SYSTEM`."""
HOMES = (Path("/home"), Path("/root"))
NONE = "none"
DOCTOR_S = 5.0

Ask = Callable[[str], str]


@dataclass(frozen=True, slots=True)
class Choices:
    """Equipment of a vehicle, as given by options, unchecked."""

    autopilot: str
    connect: str
    radio: str | None
    """NAME[:OPTIONS]@URL; None: measurements arrive on the autopilot's link or `ranging`."""
    ranging: str | None
    preset: str | None
    fence: Path | None


def run(arguments: argparse.Namespace, ask: Ask = input) -> int:
    """Run the command; return the exit code."""
    directory = arguments.directory or _usual_directory()
    if arguments.remove:
        _say(*remove_files(directory))
        return 0
    choices = _choices(arguments, ask if sys.stdin.isatty() or ask is not input else None)
    contents = site_contents(choices)
    config = check_files(contents)
    ranging = () if choices.ranging is None else (choices.ranging,)
    links = flight_links(choices.connect, ranging, config.radios)
    check_exposure(
        links,
        has_key=config.link.signing_key_file is not None,
        unsigned_ranging=config.link.unsigned_ranging,
        remedy="or start from a --preset that has link.signing_key_file",
    )
    link = links[0].transport
    files = {directory / name: content for name, content in contents.items()}
    if arguments.unit_directory is not None:
        files[arguments.unit_directory / UNIT] = unit(directory, arguments.user or _own_name())
    write_files(directory, files)
    _say(*(f"wrote {path}" for path in files))
    return _finish(arguments, choices, link, directory)


def _finish(
    arguments: argparse.Namespace, choices: Choices, link: Transport, directory: Path
) -> int:
    """Compile, examine and advise; the written files stay regardless of the result."""
    config = load_config(directory / CONFIG)
    try:
        if not arguments.no_warm_up and kernel_cache.can_compile():
            try:
                _say(compile_kernels())
            except CompanionError as error:
                _say(f"{error}; kernels run as plain Python, which suffices in flight")
        findings = [] if arguments.no_doctor else _findings(config, link)
        if findings:
            _say(*as_lines(findings))
        return exit_code(findings)
    finally:
        _say("", *guide(choices.autopilot, link, config), "", *_next(choices, directory, arguments))


def _findings(config: CompanionConfig, link: Transport) -> list[CheckResult]:
    """Return the doctor's findings; a link that does not open yet is one, as files are written."""
    try:
        return run_doctor(config, link, DOCTOR_S)
    except CompanionError as error:
        return [fail("link", str(error), "connect the autopilot, and run the doctor again")]


def _next(choices: Choices, directory: Path, arguments: argparse.Namespace) -> list[str]:
    config = shlex.quote(str(directory / CONFIG))
    lines = [
        "then:",
        f"  companion doctor --connect {shlex.quote(choices.connect)} --config {config}",
        f"  companion {options(choices)} --config {config}",
    ]
    has_unit = any((folder / UNIT).exists() for folder in SYSTEM_UNITS) and directory == SYSTEM
    if arguments.unit_directory is not None or has_unit:
        lines.append("or at every start of the computer:")
        lines.append("  systemctl daemon-reload && systemctl enable --now companion")
    return [*lines, f"undo: companion setup --remove --directory {shlex.quote(str(directory))}"]


def options(choices: Choices) -> str:
    """Return the options of the command line besides the configuration."""
    words = ["--connect", choices.connect]
    if choices.ranging is not None:
        words += ["--ranging", choices.ranging]
    return shlex.join(words)


def site_contents(choices: Choices) -> dict[str, bytes]:
    """Return the files of a choice, by name; raise `ConfigError` for an invalid one."""
    raw: dict[str, Any] = {KEY: SCHEMA_VERSION}
    if choices.preset is not None:
        preset = preset_named(choices.preset)
        found = parse_value(read_text(preset), str(preset)) or {}
        if not isinstance(found, dict):
            raise ConfigError(f"{preset}: $: expected `key: value` lines")
        renew(found, str(preset))
        raw.update(found)
    contents: dict[str, bytes] = {}
    if choices.radio is not None:
        radio = parse_radio_option(choices.radio)
        raw["radios"] = _with_radio(raw.get("radios") or [], msgspec.to_builtins(radio))
    if choices.fence is not None:
        read_fence(choices.fence)
        name = f"fence{choices.fence.suffix.lower()}"
        contents[name] = read_text(choices.fence, FENCE_BYTES).encode()
        limits = {k: v for k, v in (raw.get("limits") or {}).items() if k != "fence_enu_m"}
        raw["limits"] = {**limits, "fence_file": name}
    head = "# Made by `companion setup`; `companion config show --config FILE` has every value.\n"
    text = yaml.safe_dump(raw, sort_keys=False, allow_unicode=True)
    service = f"COMPANION_OPTIONS={options(choices)}\n"
    return {**contents, CONFIG: (head + text).encode(), SERVICE_OPTIONS: service.encode()}


def _with_radio(radios: list[dict[str, Any]], radio: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a preset's radios, with the chosen one in place of the one of that name."""
    same = next((each for each in radios if each.get("name") == radio["name"]), {})
    for section in ("settings", "options"):
        radio[section] = {**(same.get(section) or {}), **radio[section]}
    return [*(each for each in radios if each is not same), radio]


def unit(directory: Path, user: str) -> bytes:
    """Return the program's own unit for this installation."""
    text = read_text(shipped_file(f"systemd/{UNIT}"))
    program = shutil.which("companion") or str(Path(sys.argv[0]).absolute())
    text = text.replace("/opt/companion/bin/companion", _unit_word(program))
    config = _unit_word(str(directory.absolute() / CONFIG))
    text = text.replace(f"{SYSTEM}/{CONFIG}", config)
    text = text.replace(f"{SYSTEM}/", f"{directory.absolute()}/".replace("%", "%%"))
    if any(each.is_relative_to(home) for each in (Path(program), directory) for home in HOMES):
        text = text.replace("ProtectHome=yes", "ProtectHome=read-only")
    return text.replace("User=companion\n", f"User={user}\n").encode()


def _unit_word(path: str) -> str:
    """Return a path as one word of a command in a unit: systemd.service(5), "Command lines"."""
    for character in "%$":
        path = path.replace(character, 2 * character)
    if not re.search(r"""[\s"'\\;]""", path):
        return path
    escaped = re.sub(r"""(["\\])""", r"\\\1", path)
    return f'"{escaped}"'


def _own_name() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        raise ConfigError("setup: this user has no name; specify one with --user") from None


def _usual_directory() -> Path:
    if os.geteuid() == 0:
        return SYSTEM
    configs = os.environ.get("XDG_CONFIG_HOME") or os.path.expanduser("~/.config")
    if configs.startswith("~"):
        raise ConfigError("setup: there is no HOME to write to; choose a folder with --directory")
    return Path(configs) / "companion"


def _choices(arguments: argparse.Namespace, ask: Ask | None) -> Choices:
    """Return choices from flags, and from answers where flags are missing."""
    if ask is None and arguments.link is None:
        raise ConfigError(f"setup: specify the link to the autopilot: --connect {USUAL_LINK}")
    asked = _Questions(ask)
    autopilot = asked.one("Autopilot, px4 or ardupilot", arguments.kind, AUTOPILOTS[0], AUTOPILOTS)
    connect = asked.one("Link to the autopilot", arguments.link, USUAL_LINK)
    radio = asked.one("Radio as NAME@URL (companion radio list)", arguments.own_radio, NONE)
    suggested = radio.partition("@")[0].partition(":")[0]
    known = preset_names()
    preset = asked.one("Preset", arguments.preset, suggested if suggested in known else "default")
    fence = asked.one("Fence, a .plan or .kml file", arguments.site, NONE)
    return Choices(
        autopilot=autopilot,
        connect=connect,
        radio=None if radio == NONE else radio,
        ranging=arguments.own_ranging,
        preset=None if preset == "default" else preset,
        fence=None if fence == NONE else Path(os.path.expanduser(fence)),
    )


class _Questions:
    """Asks on a terminal for values without a flag; without a terminal defaults apply."""

    def __init__(self, ask: Ask | None) -> None:
        self._ask = ask

    def one(
        self, question: str, given: str | None, default: str, among: tuple[str, ...] = ()
    ) -> str:
        """Return the flag's value, the answer, or the default."""
        if given is not None or self._ask is None:
            return default if given is None else given
        while True:
            try:
                answer = self._ask(f"{question} [{default}]: ").strip() or default
            except EOFError:
                raise ConfigError("setup: no answer; nothing was written") from None
            if not among or answer in among:
                return answer
            _say(f"one of: {', '.join(among)}")


def _say(*lines: str) -> None:
    for line in lines:
        sys.stdout.write(f"{line}\n")
    sys.stdout.flush()
