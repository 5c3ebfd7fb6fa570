"""Facts and findings of the doctor: as values, as lines for people and as JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import Enum

from companion.domain import Autopilot, VehicleClass
from companion.geometry.coordinates import LocalOrigin
from companion.guidance.events import AutopilotFenceRead
from companion.guidance.readiness import FENCE_MESSAGE, REQUIREMENTS, Requirement
from companion.link.autopilot_fence import NO_ANSWER
from companion.link.quality import RadioStatus


@dataclass(frozen=True, slots=True)
class StreamRate:
    """Measured rate of one kind of message of the autopilot."""

    name: str
    asked_hz: float
    count: int
    seconds: float
    """Time in which they were received."""

    @property
    def measured_hz(self) -> float:
        """Measured rate, messages per second."""
        return self.count / self.seconds if self.seconds > 0.0 else 0.0


@dataclass(frozen=True, slots=True)
class AutopilotFacts:
    """Facts that the autopilot reported."""

    autopilot: Autopilot
    vehicle_class: VehicleClass
    system_id: int
    component_id: int
    mode: str
    """Mode by the name that its operators use."""
    is_armed: bool
    rates: tuple[StreamRate, ...]
    parameters: Mapping[str, float | None]
    """Values of the requested parameters by name; None: not reported."""
    has_rc: bool | None
    """True if it hears a transmitter; None: not reported."""
    heard: frozenset[str]
    """Kinds of messages received, by MAVLink's names; those without content do not count."""
    origin: LocalOrigin | None
    """Origin of the local frame; None: unknown to the autopilot, or not reported."""
    estimator_flags: int | None
    """ESTIMATOR_STATUS_FLAGS, or EKF_STATUS_FLAGS; None: not reported."""
    gps_fix: int | None
    """GPS_FIX_TYPE; None: not reported."""
    battery_pct: int | None
    round_trip_s: float | None
    clock_offset_s: float | None
    loss: float | None
    """Share of its frames that were lost, 0 to 1."""
    fence: AutopilotFenceRead | None = None
    """The autopilot's own fence; None: not requested."""

    @property
    def is_unanswered(self) -> bool:
        """True if all requests remained without an answer: the line may be open one way only."""
        is_fence_read = self.fence is not None and self.fence.problem != NO_ANSWER
        is_any_known = any(value is not None for value in self.parameters.values())
        return self.round_trip_s is None and not is_any_known and not is_fence_read

    @property
    def missing(self) -> tuple[Requirement, ...]:
        """Inputs that control needs and that were not received, except the fence."""
        return tuple(
            row
            for row in REQUIREMENTS
            if row.is_needed(self.autopilot)
            and row.message not in self.heard
            and row.message != FENCE_MESSAGE
        )


@dataclass(frozen=True, slots=True)
class LinkFacts:
    """Traffic on the vehicle's link."""

    name: str
    waited_s: float
    """Time of listening for an autopilot."""
    autopilot: AutopilotFacts | None
    other_autopilots: tuple[int, ...]
    other_companions: tuple[int, ...]
    """System ids under which another component with the companion's id sent."""
    non_autopilots: tuple[str, ...]
    """Senders that are not autopilots: ids and kind."""
    bytes_received: int
    bad_frames: int
    """Frames that failed their checksum or could not be decoded."""
    unproved_frames: int
    """Frames that signing refused; 0 without a key."""
    resident_mb: float | None = None
    """Memory of this process while it listened, with all modules of a flight loaded."""
    processor_pct: float | None = None
    """Load of one core by receiving the streams, in percent."""


@dataclass(frozen=True, slots=True)
class FolderFacts:
    """A directory that is written to in flight."""

    path: str
    problem: str | None
    """Reason why the folder cannot be written."""
    free_mb: float | None = None
    synced_write_s: float | None = None
    """Time to write a megabyte to the disk."""


@dataclass(frozen=True, slots=True)
class HostFacts:
    """Facts about this computer."""

    python: tuple[int, int, int]
    numpy: str
    can_compile_kernels: bool
    are_kernels_compiled: bool
    priority: str | None
    """Priority granted to a flight started in the same way; None: normal priority."""
    logs: FolderFacts
    state: FolderFacts
    key_problem: str | None
    """Fault of the signing key; None: no fault, or no key."""
    has_key: bool
    unix_s: float
    is_clock_synchronised: bool | None
    """True if the system synchronises its clock; None: not reported."""


@dataclass(frozen=True, slots=True)
class RadioFacts:
    """One radio after listening to it for a while."""

    name: str
    url: str
    problem: str | None = None
    """Reason why it cannot be heard at all."""
    status: RadioStatus | None = None
    bytes: int = 0
    has_clock: bool = False
    """True if it reported its own time."""
    uncalibrated: tuple[str, ...] = ()
    """Quantities that it measures without a calibration: `ranges`, `bearings`."""
    needs_offset: bool = False
    """True if its ranges have a constant offset that prevents localisation until it is set."""


@dataclass(frozen=True, slots=True)
class Facts:
    """All facts of one run."""

    host: HostFacts
    link: LinkFacts
    radios: tuple[RadioFacts, ...] = ()


class Level(Enum):
    """Severity of a finding."""

    OK = "OK"
    WARN = "WARN"
    """Flight is possible, but less good or less safe than it could be."""
    FAIL = "FAIL"
    """Fault that forbids a flight."""


@dataclass(frozen=True, slots=True)
class CheckResult:
    """One line of the result."""

    level: Level
    subject: str
    text: str
    fix: str = ""


def ok(subject: str, text: str) -> CheckResult:
    """Return a finding without a fault."""
    return CheckResult(Level.OK, subject, text)


def warn(subject: str, text: str, fix: str) -> CheckResult:
    """Return a finding that should be corrected."""
    return CheckResult(Level.WARN, subject, text, fix)


def fail(subject: str, text: str, fix: str) -> CheckResult:
    """Return a finding that has to be corrected before any flight."""
    return CheckResult(Level.FAIL, subject, text, fix)


SUBJECT_WIDTH = 24


def as_lines(findings: Sequence[CheckResult]) -> list[str]:
    """Return a line per finding, another for its remedy, and a summary at the end."""
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
    """Return plain values."""
    return {
        "is_fit": not any(finding.level is Level.FAIL for finding in findings),
        "findings": [{**asdict(finding), "level": finding.level.value} for finding in findings],
    }
