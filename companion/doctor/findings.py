"""What the doctor looked at and what it found, as values, as lines for people and as JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import Enum

from companion.domain import Autopilot, VehicleClass
from companion.geometry.coordinates import LocalOrigin
from companion.guidance.events import AutopilotFenceRead
from companion.guidance.flight.requirements import FENCE_MESSAGE, REQUIREMENTS, Requirement
from companion.link.quality import RadioStatus


@dataclass(frozen=True, slots=True)
class StreamRate:
    """One kind of message of the autopilot."""

    name: str
    """As MAVLink calls it."""
    asked_hz: float
    count: int
    """Messages that came ..."""
    seconds: float
    """... in this time."""

    @property
    def measured_hz(self) -> float:
        """Messages per second."""
        return self.count / self.seconds if self.seconds > 0.0 else 0.0


@dataclass(frozen=True, slots=True)
class AutopilotFacts:
    """What the autopilot said."""

    autopilot: Autopilot
    vehicle_class: VehicleClass
    system_id: int
    component_id: int
    mode: str
    """As its operator calls it."""
    is_armed: bool
    rates: tuple[StreamRate, ...]
    parameters: Mapping[str, float | None]
    """Those that were asked for; None: it does not report it."""
    has_rc: bool | None
    """Whether it hears a transmitter; None: it does not report it."""
    heard: frozenset[str]
    """Kinds of messages that came, by MAVLink's names; those that report nothing do not count."""
    origin: LocalOrigin | None
    """Of the local frame; None: it does not know it, or does not report it."""
    estimator_flags: int | None
    """ESTIMATOR_STATUS_FLAGS, or EKF_STATUS_FLAGS; None: it does not report them."""
    gps_fix: int | None
    """GPS_FIX_TYPE; None: it does not report it."""
    battery_pct: int | None
    round_trip_s: float | None
    clock_offset_s: float | None
    loss: float | None
    """Share of its frames that did not come, 0 to 1."""
    fence: AutopilotFenceRead | None = None
    """Its own fence; None: not asked for."""

    @property
    def missing(self) -> tuple[Requirement, ...]:
        """Inputs that control needs and that did not come; its fence is judged by itself."""
        return tuple(
            row
            for row in REQUIREMENTS
            if row.is_needed(self.autopilot)
            and row.message not in self.heard
            and row.message != FENCE_MESSAGE
        )


@dataclass(frozen=True, slots=True)
class LinkFacts:
    """What was heard on the vehicle's link."""

    name: str
    waited_s: float
    """How long an autopilot was listened for."""
    autopilot: AutopilotFacts | None
    """None: none was heard."""
    other_autopilots: tuple[int, ...]
    other_companions: tuple[int, ...]
    """System ids under which another component with the companion's id spoke."""
    unfit: tuple[str, ...]
    """Senders that fly nothing: ids and kind."""
    bytes_received: int
    bad_frames: int
    """That failed their checksum or made no sense."""
    unproved_frames: int
    """That signing refused; 0 without a key."""
    resident_mb: float | None = None
    """Memory of this process while it listened, with all that a flight loads."""
    processor_pct: float | None = None
    """Of one core, for taking the streams in."""


@dataclass(frozen=True, slots=True)
class PlaceFacts:
    """A directory that is written to in flight."""

    path: str
    problem: str | None
    """Why it cannot be written, in words."""
    free_mb: float | None = None
    synced_write_s: float | None = None
    """What writing a megabyte took, until it was on the disk."""


@dataclass(frozen=True, slots=True)
class HostFacts:
    """What there is on this computer."""

    python: tuple[int, int, int]
    numpy: str
    numba: str | None
    """Its version; None: not installed, or not needed."""
    has_native_kernels: bool
    """Whether kernels were compiled before they were installed."""
    are_kernels_kept: bool
    """Whether they were compiled before, so that a flight need not wait for it."""
    logs: PlaceFacts
    state: PlaceFacts
    key_problem: str | None
    """What is wrong with the signing key; None: nothing, or there is none."""
    has_key: bool
    unix_s: float
    is_clock_synchronised: bool | None
    """Whether the system keeps its clock by others; None: it does not report it."""


@dataclass(frozen=True, slots=True)
class RadioFacts:
    """One radio, listened to for a while."""

    name: str
    url: str
    problem: str | None = None
    """Why it cannot be heard at all."""
    status: RadioStatus | None = None
    bytes: int = 0
    has_clock: bool = False
    """Whether it told its own time."""
    uncalibrated: tuple[str, ...] = ()
    """What it gives and no setting corrects: `ranges`, `bearings`."""
    needs_offset: bool = False
    """Its ranges have a constant without which nothing is localised, and none is set."""


@dataclass(frozen=True, slots=True)
class Facts:
    """Everything."""

    host: HostFacts
    link: LinkFacts
    radios: tuple[RadioFacts, ...] = ()


class Level(Enum):
    """How bad it is."""

    OK = "OK"
    WARN = "WARN"
    """It flies, but not as well, or not as safely, as it could."""
    FAIL = "FAIL"
    """Do not fly like this."""


@dataclass(frozen=True, slots=True)
class CheckResult:
    """One line."""

    level: Level
    subject: str
    text: str
    fix: str = ""


def ok(subject: str, text: str) -> CheckResult:
    """Nothing to do."""
    return CheckResult(Level.OK, subject, text)


def warn(subject: str, text: str, fix: str) -> CheckResult:
    """Something to correct."""
    return CheckResult(Level.WARN, subject, text, fix)


def fail(subject: str, text: str, fix: str) -> CheckResult:
    """Something to correct before any flight."""
    return CheckResult(Level.FAIL, subject, text, fix)


SUBJECT_WIDTH = 24


def as_lines(findings: Sequence[CheckResult]) -> list[str]:
    """A line per finding, one below it for the remedy, and a last one that adds up."""
    lines = []
    for finding in findings:
        lines.append(f"{finding.level.value:<5} {finding.subject:<{SUBJECT_WIDTH}} {finding.text}")
        if finding.fix:
            lines.append(f"{'':<5} {'':<{SUBJECT_WIDTH}} -> {finding.fix}")
    counts = {level: sum(f.level is level for f in findings) for level in Level}
    verdict = "do not fly" if counts[Level.FAIL] else "fit to fly"
    counted = f"{counts[Level.OK]} ok, {counts[Level.WARN]} warnings, {counts[Level.FAIL]} failures"
    return [*lines, f"{verdict}: {counted}"]


def as_json(findings: Sequence[CheckResult]) -> dict[str, object]:
    """Plain values."""
    return {
        "is_fit": not any(finding.level is Level.FAIL for finding in findings),
        "findings": [{**asdict(finding), "level": finding.level.value} for finding in findings],
    }
