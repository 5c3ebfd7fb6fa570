"""The whole doctor: facts about this computer and the link, and findings about the facts.

`examine` is pure: it turns facts into one line each, with a remedy.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from companion import kernel_cache
from companion.config.schema import CompanionConfig, load_config, with_radios, with_signing_key
from companion.diagnostics import HOW_TO_ALLOW, NORMAL_PRIORITY, process_use, raised_priority
from companion.doctor.autopilot_settings import check_fence, check_parameters
from companion.doctor.findings import (
    AutopilotFacts,
    CheckResult,
    Facts,
    FolderFacts,
    HostFacts,
    Level,
    LinkFacts,
    StreamRate,
    as_json,
    as_lines,
    fail,
    ok,
    warn,
)
from companion.doctor.probe import DoctorProbe, check_radios, inspect_radios
from companion.domain import Autopilot
from companion.errors import CompanionError
from companion.flight_setup import radio_links, with_kept_offsets
from companion.guidance.vehicle import vehicle_refusal
from companion.io.files import write_bytes_atomic
from companion.io.links.transports import Transport, check_exposure, parse_flight_link
from companion.io.shell import Clock, Shell
from companion.io.state_directory import (
    VehicleLock,
    load_signing_key,
    resolved_address,
    state_directory,
)
from companion.kernel import IS_NATIVE, IS_SWITCHED_OFF
from companion.link.intake import Authenticity
from companion.link.interface import LinkRole
from companion.link.outlet import COMPONENT_ID
from companion.run import link_name, open_signing

MEGABYTE = 1_000_000
_SYNCHRONISED = Path("/run/systemd/timesync/synchronized")
_SYNCHRONISERS = (Path("/run/systemd/timesync"), Path("/run/chrony"), Path("/run/ntpd.pid"))


def inspect_host(logs: Path, state: Path, key_file: str | None) -> HostFacts:
    """Return the facts about this computer; checkpoints and locks are kept in `state`."""
    with raised_priority() as priority:
        pass
    return HostFacts(
        python=(sys.version_info.major, sys.version_info.minor, sys.version_info.micro),
        numpy=_version("numpy") or "?",
        can_compile_kernels=not IS_SWITCHED_OFF and kernel_cache.can_compile(),
        are_kernels_compiled=IS_NATIVE,
        priority=priority,
        logs=inspect_folder(logs),
        state=inspect_folder(state),
        key_problem=None if key_file is None else _key_problem(Path(key_file)),
        has_key=key_file is not None,
        unix_s=time.time(),
        is_clock_synchronised=_is_clock_synchronised(),
    )


def inspect_folder(directory: Path) -> FolderFacts:
    """Measure if and how fast a directory can be written; a missing one is created and kept."""
    probe = directory / f".doctor.{os.getpid()}"
    try:
        directory.mkdir(parents=True, exist_ok=True)
        began_s = time.monotonic()
        write_bytes_atomic(probe, bytes(MEGABYTE))
        took_s = time.monotonic() - began_s
        room = os.statvfs(directory)
    except OSError as error:
        return FolderFacts(str(directory), error.strerror or str(error))
    except CompanionError as error:
        return FolderFacts(str(directory), str(error.__cause__ or error))
    finally:
        with suppress(OSError):
            probe.unlink(missing_ok=True)
    free_mb = room.f_bavail * room.f_frsize / 1e6
    return FolderFacts(str(directory), None, round(free_mb, 1), round(took_s, 4))


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _key_problem(path: Path) -> str | None:
    try:
        load_signing_key(path)
    except CompanionError as error:
        return str(error)
    return None


def _is_clock_synchronised() -> bool | None:
    """Return True if the file system shows a synchronised clock; None if it shows nothing."""
    if _SYNCHRONISED.exists():
        return True
    return None if not any(path.exists() for path in _SYNCHRONISERS) else False


NEEDED_STREAMS = {"HEARTBEAT": 0.5, "LOCAL_POSITION_NED": 4.0, "ATTITUDE": 2.0}
"""Lowest rate for a flight, in Hz."""
ESTIMATED = ("LOCAL_POSITION_NED", "ATTITUDE", "GLOBAL_POSITION_INT", "HOME_POSITION")
"""Sent only once the autopilot knows its position; PX4 1.15 withholds ATTITUDE as well."""
NEEDED_ESTIMATES = {
    "attitude": 1,
    "horizontal velocity": 2,
    "horizontal position": 8 | 16,
    "height": 32 | 64,
}
"""Bits of ESTIMATOR_STATUS_FLAGS and EKF_STATUS_FLAGS, which are the same; one of each will do."""
ENOUGH_SHARE = 0.8
"""Minimum share of the requested rate."""
NOTICED_LOSS, MUCH_LOSS = 0.02, 0.30
SLOW_ROUND_TRIP_S, USELESS_ROUND_TRIP_S = 0.1, 0.5
FIX_3D = 3
LOW_BATTERY_PCT = 30
SLOW_WRITE_S = 1.0
MIN_FREE_MB = 50.0
MIN_UNIX_S = 1.735e9
"""Unix time of 2024-12-24; a clock before that was never set."""


def examine(facts: Facts, config: CompanionConfig) -> list[CheckResult]:
    """Return all findings, in the order of a checklist."""
    host, link = _check_host(facts.host, config), _check_link(facts.link, config)
    return [*host, *link, *check_radios(facts.radios)]


def exit_code(findings: list[CheckResult]) -> int:
    """Return 0 if no finding forbids a flight, 1 otherwise."""
    return int(any(finding.level is Level.FAIL for finding in findings))


# The computer


def _check_host(host: HostFacts, config: CompanionConfig) -> Iterator[CheckResult]:
    version = ".".join(str(part) for part in host.python)
    compiled = "compiled ahead" if host.are_kernels_compiled else "in plain Python"
    yield ok("python", f"{version}, numpy {host.numpy}, kernels {compiled}")
    if host.can_compile_kernels and not host.are_kernels_compiled:
        text = "numba is installed, but the kernels run as plain Python"
        yield warn("kernels", text, "run companion warm-up, as the user that flies")
    if host.priority is None:
        yield warn("priority", NORMAL_PRIORITY, HOW_TO_ALLOW)
    else:
        yield ok("priority", host.priority)
    yield _check_logs(host.logs, config)
    yield _check_state(host.state)
    yield _check_key(host)
    yield _check_clock(host)


def _check_logs(folder: FolderFacts, config: CompanionConfig) -> CheckResult:
    if folder.problem is not None:
        text = f"{folder.path}: {folder.problem}"
        return fail("log.directory", text, "choose another folder in log.directory, or repair it")
    free_mb, took_s = folder.free_mb or 0.0, folder.synced_write_s or 0.0
    text = f"{folder.path}: {free_mb:.0f} MB free, writing 1 MB takes {took_s:.2f} s"
    if free_mb < MIN_FREE_MB:
        return fail("log.directory", text, "make room, or set log.keep_flights")
    if free_mb < config.log.max_mb:
        fix = f"make room for log.max_mb ({config.log.max_mb:g}), or lower it"
        return warn("log.directory", text, fix)
    if took_s > SLOW_WRITE_S:
        return warn("log.directory", text, "use a faster disk: a log that waits loses entries")
    return ok("log.directory", text)


def _check_state(folder: FolderFacts) -> CheckResult:
    if folder.problem is not None:
        text = f"{folder.path}: {folder.problem}: no restart in flight, and no lock"
        return warn("process.state_directory", text, "choose another folder, or repair it")
    return ok("process.state_directory", folder.path)


def _check_key(host: HostFacts) -> CheckResult:
    if not host.has_key:
        text = "none: anyone on the link may command the vehicle"
        return warn("signing key", text, "make one, and set it up on both sides; docs/ports.md")
    if host.key_problem is not None:
        return fail("signing key", host.key_problem, "repair the file, or choose another")
    return ok("signing key", "readable by its owner only")


def _check_clock(host: HostFacts) -> CheckResult:
    if host.unix_s < MIN_UNIX_S:
        text = "this computer's clock was never set"
        return (fail if host.has_key else warn)("clock", text, "set it, by NTP or GPS")
    if host.is_clock_synchronised is False:
        return warn("clock", "set, but not synchronised", "wait for NTP, or set it by GPS")
    return ok("clock", "set and synchronised" if host.is_clock_synchronised else "set")


# The link


def _check_link(link: LinkFacts, config: CompanionConfig) -> Iterator[CheckResult]:
    autopilot = link.autopilot
    if autopilot is None:
        yield _no_autopilot(link, config)
        return
    yield _check_identity(autopilot)
    yield from _check_other_systems(link, autopilot, config)
    yield _check_loss(link, autopilot)
    if link.resident_mb is not None:
        text = (
            f"{link.resident_mb:.0f} MB, {link.processor_pct:.1f} % of one core for these streams"
        )
        yield ok("process", text)
    lacking = _missing_estimates(autopilot)
    if lacking:
        text = f"not ready: no {', no '.join(lacking)}"
        fix = "wait for its sensors and a position fix under an open sky, then run this again"
        yield fail("estimator", text, fix)
    elif autopilot.estimator_flags is not None:
        yield ok("estimator", f"ready: {', '.join(NEEDED_ESTIMATES)}")
    yield from _check_readiness(autopilot)
    for rate in autopilot.rates:
        if lacking and rate.count == 0 and rate.name in ESTIMATED:
            yield warn(rate.name, "none: it needs the estimator", "see estimator, above")
        elif rate.count or _is_expected(rate.name, autopilot):
            yield _check_rate(rate)
    yield _check_time(autopilot)
    yield from check_parameters(autopilot, config)
    yield from check_fence(autopilot, config)


def _no_autopilot(link: LinkFacts, config: CompanionConfig) -> CheckResult:
    text = f"{link.name}: no autopilot heard in {link.waited_s:.0f} s"
    if link.unproved_frames:
        fix = "set the same signing key up on both sides"
        return fail(
            "autopilot", f"{text}; {link.unproved_frames} frames not signed with our key", fix
        )
    if link.other_autopilots and config.vehicle.system_id is None:
        heard = ", ".join(str(number) for number in link.other_autopilots)
        text = f"{link.name}: systems {heard} are autopilots on this link"
        return fail("vehicle.system_id", text, "set it to yours: until then none is flown")
    if link.other_autopilots:
        heard = ", ".join(str(number) for number in link.other_autopilots)
        fix = f"set vehicle.system_id ({config.vehicle.system_id}) to one of them"
        return fail("autopilot", f"{text}, but system {heard}", fix)
    if link.non_autopilots:
        heard = ", ".join(link.non_autopilots)
        return fail(
            "autopilot", f"{text}, but {heard}", "none of these is an autopilot: check its link"
        )
    if link.bytes_received:
        fix = "check the protocol and the serial speed"
        return fail("autopilot", f"{text}; {link.bytes_received} bytes that are not MAVLink", fix)
    return fail("autopilot", text, "check that the autopilot sends there, and the port")


def _check_identity(facts: AutopilotFacts) -> CheckResult:
    ids = f"system {facts.system_id}, component {facts.component_id}"
    state = "armed" if facts.is_armed else "disarmed"
    kind = f"{facts.autopilot.value} {facts.vehicle_class.value}"
    text = f"{kind}, {ids}, {state}, in {facts.mode}"
    if facts.autopilot is Autopilot.OTHER:
        return fail("autopilot", text, "only PX4 and ArduPilot modes are supported")
    refusal = vehicle_refusal(facts.vehicle_class, facts.autopilot)
    if refusal is not None:
        parameter = "FRAME_CLASS" if facts.autopilot is Autopilot.ARDUPILOT else "MAV_TYPE"
        fix = f"fly it by hand; if it is a multicopter, set {parameter}"
        return fail("autopilot", f"{text}: {refusal}", fix)
    return ok("autopilot", text)


def _check_other_systems(
    link: LinkFacts, facts: AutopilotFacts, config: CompanionConfig
) -> Iterator[CheckResult]:
    if link.other_autopilots and config.vehicle.system_id is None:
        heard = ", ".join(str(number) for number in link.other_autopilots)
        text = f"system {heard} sends on this link, too"
        yield fail("vehicle.system_id", text, "set it, or the first one heard is flown")
    if facts.system_id in link.other_companions:
        own_id, fix = config.link.component_id, "stop the other companion, or give it another id"
        text = f"another component {own_id or COMPONENT_ID} of this vehicle sends on this link"
        if own_id is None:
            yield warn(
                "companion", f"{text}: ours takes another id", "if it is a companion, stop it"
            )
        else:
            yield fail("companion", text, fix)


def _check_loss(link: LinkFacts, facts: AutopilotFacts) -> CheckResult:
    if facts.is_unanswered:
        fix = "check the wire to its receiving pin; if it wants signatures, give the key"
        return fail("link", f"{link.name}: the autopilot answers no request", fix)
    loss = facts.loss or 0.0
    text = f"{link.name}: {100.0 * loss:.1f} % lost, {link.bad_frames} bad frames"
    if loss > MUCH_LOSS:
        return fail(
            "link", text, "check the radio and the cable; above 30 % loss no flight is reliable"
        )
    if loss > NOTICED_LOSS or link.bad_frames > 0:
        return warn("link", text, "check antennas, cables, serial speed and rates")
    return ok("link", text)


def _missing_estimates(facts: AutopilotFacts) -> list[str]:
    """Return the names of the states that the autopilot does not estimate yet."""
    flags = facts.estimator_flags
    if flags is not None:
        return [name for name, bits in NEEDED_ESTIMATES.items() if not flags & bits]
    has_position = {"LOCAL_POSITION_NED", "GPS_GLOBAL_ORIGIN"} & facts.heard
    return [] if has_position else ["position"]


def _check_rate(rate: StreamRate) -> CheckResult:
    text = f"{rate.measured_hz:.1f} Hz, requested {rate.asked_hz:g}"
    fix = "raise the link's rate (PX4: MAV_x_RATE, ArduPilot: SRx_*), or use a faster link"
    if rate.measured_hz < NEEDED_STREAMS.get(rate.name, 0.0) or rate.count == 0:
        is_needed = rate.name in NEEDED_STREAMS
        return (fail if is_needed else warn)(rate.name, text, fix)
    due = rate.asked_hz * rate.seconds
    is_enough = rate.count >= ENOUGH_SHARE * due - 1.0  # one may come just after the end
    return ok(rate.name, text) if is_enough else warn(rate.name, text, fix)


def _is_expected(name: str, facts: AutopilotFacts) -> bool:
    """Return True if an autopilot sends a stream at all in its current state."""
    is_px4 = facts.autopilot is Autopilot.PX4
    expected = {
        "ESTIMATOR_STATUS": is_px4,
        "EKF_STATUS_REPORT": facts.autopilot is Autopilot.ARDUPILOT,
        # ArduPilot reports a target in GUIDED alone
        "POSITION_TARGET_LOCAL_NED": facts.is_armed and (is_px4 or facts.mode == "GUIDED"),
        "RC_CHANNELS": facts.has_rc is not False,
        "GPS2_RAW": False,  # only where a second receiver is fitted
    }
    return expected.get(name, True)


def _check_time(facts: AutopilotFacts) -> CheckResult:
    if facts.round_trip_s is None or facts.clock_offset_s is None:
        text = "the autopilot does not answer TIMESYNC: arrival counts as the time of measurement"
        return warn("time", text, "update the autopilot, or accept errors of metres in fast flight")
    text = f"round trip {1e3 * facts.round_trip_s:.1f} ms, offset {facts.clock_offset_s:.3f} s"
    if facts.round_trip_s > USELESS_ROUND_TRIP_S:
        return fail("time", text, "use a faster link: the guard assumes limits.latency_s")
    if facts.round_trip_s > SLOW_ROUND_TRIP_S:
        return warn("time", text, "use a faster link, or raise limits.latency_s")
    return ok("time", text)


def _check_readiness(facts: AutopilotFacts) -> Iterator[CheckResult]:
    missing = list(dict.fromkeys(row.text for row in facts.missing))
    if missing:
        fix = "wait for a position fix; indoors nothing is flown without one"
        yield warn("position", f"missing: {', '.join(missing)}", fix)
    else:
        yield ok("position", "all that control needs is reported")
    if facts.gps_fix is not None and facts.gps_fix < FIX_3D:
        yield warn("GPS", f"no 3D fix (type {facts.gps_fix})", "wait under an open sky")
    if facts.battery_pct is not None and facts.battery_pct < LOW_BATTERY_PCT:
        yield warn("battery", f"{facts.battery_pct} %", "charge it")
    none = "none: only a ground station's mode switch can take over"
    rc = {True: "heard", False: none, None: "the autopilot does not report it"}[facts.has_rc]
    yield ok("RC", rc)


def run_doctor(config: CompanionConfig, link: Transport, duration_s: float) -> list[CheckResult]:
    """Examine all that a flight with `config` needs; raise `LinkError` if a companion runs."""
    state = state_directory(config.process.state_directory, os.environ)
    key_file = config.link.signing_key_file
    host = inspect_host(Path(config.log.directory), state, key_file)
    can_sign = host.key_problem is None
    found = inspect_link(config, link, duration_s, state, can_sign=can_sign)
    facts = Facts(host, found, inspect_radios(config.radios, duration_s))
    return examine(facts, config)


def inspect_link(
    config: CompanionConfig, link: Transport, duration_s: float, state: Path, *, can_sign: bool
) -> LinkFacts:
    """Listen on the vehicle's link; `can_sign`: the key, if any, is usable."""
    name = link_name(link)
    lock = VehicleLock(state, name, config.vehicle.system_id, resolved_address(link))
    keeper = open_signing(config) if can_sign else None
    clock = Clock()
    try:
        signing = None if keeper is None else keeper.signing
        authenticity = Authenticity(signing, time.time() - clock.now_s())
        component_id = config.link.component_id
        probe = DoctorProbe(name, config.vehicle.system_id, authenticity, duration_s, component_id)
        before = process_use()
        Shell(probe, [link], clock).run_whole()
        use, took_s = process_use(), clock.now_s()
        return replace(
            probe.facts(),
            resident_mb=use.resident_mb,
            processor_pct=100.0 * (use.processor_s - before.processor_s) / took_s,
        )
    finally:
        if keeper is not None:
            keeper.close()
        lock.release()


def run(arguments: argparse.Namespace) -> int:
    """Examine a vehicle, print what was found, and return the exit code."""
    config = load_config(arguments.config)
    if arguments.key is not None:
        config = with_signing_key(config, arguments.key)
    config = with_kept_offsets(with_radios(config, arguments.radios, arguments.config))
    link = parse_flight_link(arguments.link, LinkRole.VEHICLE)
    if not arguments.is_insecure:
        has_key = config.link.signing_key_file is not None
        check_exposure([link, *radio_links(config.radios)], has_key=has_key)
    findings = run_doctor(config, link.transport, arguments.seconds)
    if arguments.json:
        print(json.dumps(as_json(findings), indent=2))
    else:
        print("\n".join(as_lines(findings)))
    return exit_code(findings)
