"""What the operator and the event log are told, each rarely enough.

Theory of operation of findings. What was told stays true for the operator until it has been gone
for a while, or something worse comes: then the new state is told. A reason that was not told for
long is told at once. So two reasons that take turns at every tick are told once each, and whatever
lasts is told, at the latest a moment after it began. A lost link never waits: it is over only after
a second, so it cannot flicker.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Hashable
from dataclasses import asdict, replace

from companion.domain import EstimateState, PositionEnu, TargetEstimate, Waypoint, radii_text
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.integrity.target_motion import TargetMotion
from companion.estimation.screening.measurement_screen import RejectReason
from companion.estimation.tracker import FusionReport, TargetTracker
from companion.geometry.coordinates import LocalOrigin
from companion.guard.fence import Fence
from companion.guard.gate import GuardReason
from companion.guidance.commands import Announce, Command, Record, ReportResult, Severity
from companion.guidance.health.findings import Finding, Reason


def radius_fields(estimate: TargetEstimate) -> dict[str, object]:
    """Both radii, and what the absolute one has beside: the own place's sigma, and its source."""
    return {
        "r95_m": estimate.r95_m,
        "absolute_r95_m": estimate.absolute_r95_m,
        "own_sigma_m": estimate.own.horizontal_m,
        "own_sigma_told": estimate.own.is_told,
    }


def radii_of(estimate: TargetEstimate) -> str:
    """Both radii in words."""
    return radii_text(estimate.absolute_r95_m, estimate.r95_m)


def radius_texts(estimate: TargetEstimate) -> list[str]:
    """Both radii, and the GNSS accuracy that is in the absolute one where none was reported."""
    own, texts = estimate.own, [radii_of(estimate)]
    if not own.is_told:
        texts.append(f"GNSS accuracy not reported: assuming {own.horizontal_m:.3g} m")
    return texts


def estimate_record(report: FusionReport, estimate: TargetEstimate) -> Record:
    """The estimate after a measurement, with the innovations that led to it."""
    fields: dict[str, object] = {
        "state": estimate.state.value,
        "position_enu_m": estimate.position_enu_m,
        "covariance_m2": estimate.covariance_m2,
        "alternative_enu_m": estimate.alternative_enu_m,
        **radius_fields(estimate),
        "range_offset_m": estimate.range_offset_m,
        "bearing_offset_rad": estimate.bearing_offset_rad,
    }
    measured = report.measurement
    if measured is not None and report.sensor_enu_m is not None:
        fields["emitter_id"] = measured.emitter_id
        fields["sensor_enu_m"] = report.sensor_enu_m
        fields["range_m"] = measured.range_m
        fields["bearing_enu_rad"] = measured.bearing_enu_rad
    update = report.update
    if update is not None:
        fields["nis"] = update.nis
        for name, row in (("range", update.range), ("bearing", update.bearing)):
            if row is not None:
                fields[f"{name}_innovation"] = row.innovation
                fields[f"{name}_weight"] = row.weight
    return Record("estimate", fields)


def waiting_record(emitter_id: int, estimate: TargetEstimate) -> Record:
    """The estimate of an emitter whose turn it is not."""
    fields = {
        "emitter_id": emitter_id,
        "state": estimate.state.value,
        "position_enu_m": estimate.position_enu_m,
        "covariance_m2": estimate.covariance_m2,
        **radius_fields(estimate),
        "measurements": estimate.measurements,
    }
    return Record("waiting", fields)


def health_fields(tracker: TargetTracker, now_s: float) -> dict[str, object]:
    """How far the estimate can be trusted, as live values."""
    objection, contact = tracker.objection(now_s), tracker.integrity.contact
    return {
        **asdict(tracker.health),
        "objection": None if objection is None else objection.value,
        "range_age_s": contact.range_age_s(now_s),
        "bearing_age_s": contact.bearing_age_s(now_s),
        "agreeing": contact.agreeing_since_gap(now_s),
    }


def waypoint_record(waypoint: Waypoint) -> Record:
    """A waypoint and why it was chosen."""
    fields = {
        "position_enu_m": waypoint.position_enu_m,
        "altitude_offset_m": waypoint.altitude_offset_m,
        "reason": waypoint.reason.value,
        "detail": waypoint.detail,
    }
    return Record("waypoint", fields)


def result_of(
    estimate: TargetEstimate,
    origin: LocalOrigin | None,
    target_height_m: float,
    emitter_id: int | None = None,
    head: str = "LOCALISED",
) -> tuple[ReportResult, str]:
    """The result of the flight, in degrees where the origin is known, and the text about it.

    The radius is the absolute one, because the text is for everybody.
    """
    if origin is None:
        text = f"{head} R95 {estimate.absolute_r95_m:.1f} m"
        return ReportResult(estimate, None, None, emitter_id), text
    place = (*estimate.position_enu_m, target_height_m)
    latitude_deg, longitude_deg, _ = origin.geodetic_from_enu(place)
    text = f"{head} {latitude_deg:.7f} {longitude_deg:.7f} R95 {estimate.absolute_r95_m:.1f} m"
    return ReportResult(estimate, latitude_deg, longitude_deg, emitter_id, origin), text


class Rarely:
    """Lets the same be told only every so often."""

    def __init__(self, every_s: float) -> None:
        self._every_s = every_s
        self._told_s: dict[Hashable, float] = {}

    def is_due(self, what: Hashable, now_s: float) -> bool:
        """Whether to tell something now; if so, it counts as told."""
        told_s = self._told_s.get(what)
        if told_s is not None and now_s - told_s < self._every_s:
            return False
        self._told_s[what] = now_s
        return True


GONE_S = 1.0
"""What was told is over when it was not so for this long."""
URGENT = frozenset({Reason.NO_LINK})
TOLD_AGAIN_S = 10.0
"""The same is not told sooner while what was told before comes and goes."""


class FindingMessages:
    """Remembers what was told while in control; None stands for "nothing is wrong"."""

    def __init__(self) -> None:
        self._told: Reason | None = None
        self._told_verdict = 0
        self._seen_s = -math.inf
        """When what was told was so last."""
        self._told_s: dict[Reason | None, float] = {}

    def take(self, finding: Finding | None, now_s: float) -> bool:
        """Take in what is wrong now, or that nothing is; whether that is to be told."""
        reason = None if finding is None else finding.reason
        if reason is self._told:
            self._seen_s = now_s
            return False
        verdict = 0 if finding is None else int(finding.verdict)
        since_told_s = now_s - self._told_s.get(reason, -math.inf)
        is_worse = verdict > self._told_verdict or reason in URGENT
        is_worse = is_worse and since_told_s >= GONE_S
        if not (is_worse or now_s - self._seen_s >= GONE_S or since_told_s >= TOLD_AGAIN_S):
            return False
        self._told, self._told_verdict, self._seen_s = reason, verdict, now_s
        self._told_s[reason] = now_s
        return True


CAUTION = (
    EstimateState.SEARCHING,
    EstimateState.LOCALISED,
    EstimateState.AMBIGUOUS,
    EstimateState.DIVERGED,
)
"""The order of the announced states: a later one replaces an earlier one at once."""


class StateMessages:
    """The announced state of the estimate, with hysteresis.

    A second place whose probability is near the threshold comes and goes with every measurement.
    So a state that asks for more caution is announced at once, and one that asks for less when the
    other has not been seen for `settle_s`. The estimate itself, and whatever is decided by it,
    keeps the state of the moment.
    """

    def __init__(self) -> None:
        self._announced: EstimateState | None = None
        self._seen_s = -math.inf

    def begin(self, estimate: TargetEstimate | None) -> None:
        """Begin with an estimate that the operator knows, or with none."""
        self._announced = None if estimate is None else estimate.state
        self._seen_s = -math.inf if estimate is None else estimate.time_s

    def shown(self, estimate: TargetEstimate, now_s: float, settle_s: float) -> TargetEstimate:
        """Return the estimate with the state to announce and to show."""
        announced = self._announced
        if announced is None or now_s - self._seen_s >= settle_s:
            return estimate
        is_calmer = CAUTION.index(estimate.state) < CAUTION.index(announced)
        return replace(estimate, state=announced) if is_calmer else estimate

    def is_due(self, estimate: TargetEstimate, now_s: float, settle_s: float) -> bool:
        """Return whether to announce the state of a new estimate; if so, it counts as announced."""
        state = self.shown(estimate, now_s, settle_s).state
        is_new = state is not self._announced
        if state is estimate.state:
            self._announced, self._seen_s = state, now_s
        return is_new


SAID_EVERY_S = 30.0
"""The same reason is not told again sooner."""
LOGGED_EVERY_S = 1.0
SILENT = frozenset({GuardReason.LAGGING, GuardReason.CUT_OFF})
"""They come and go with every corner: for the log only."""


class GuardMessages:
    """Remembers what was told."""

    def __init__(self) -> None:
        self._texts = Rarely(SAID_EVERY_S)
        self._logged: tuple[GuardReason, ...] = ()
        self._logged_s: float | None = None

    def texts(self, reasons: tuple[GuardReason, ...], now_s: float) -> list[str]:
        """The reasons that the operator has not been told for a while, in words."""
        told = [reason for reason in reasons if reason not in SILENT]
        return [f"guard: {reason.value}" for reason in told if self._texts.is_due(reason, now_s)]

    def record(self, reasons: tuple[GuardReason, ...], now_s: float) -> list[str] | None:
        """The reasons for the log if they changed, and if that was not logged just now."""
        is_soon = self._logged_s is not None and now_s - self._logged_s < LOGGED_EVERY_S
        if reasons == self._logged or is_soon:
            return None
        self._logged, self._logged_s = reasons, now_s
        return [reason.name.lower() for reason in reasons]


class FenceMessages:
    """Remembers which fence the log has."""

    def __init__(self) -> None:
        self._logged: Fence | None = None

    def record(self, fence: Fence | None) -> dict[str, object] | None:
        """The fence for the log if it is another one, null for none; None: it is the same."""
        if fence is self._logged or fence == self._logged:
            return None
        self._logged = fence
        fields: dict[str, object] = {
            "polygon_enu_m": None if fence is None else fence.polygon_enu_m,
            "keep_out_enu_m": () if fence is None else fence.keep_out_enu_m,
            "margin_m": None if fence is None else fence.margin_m,
        }
        if fence is not None and fence.also_inside_enu_m:
            fields["also_inside_enu_m"] = fence.also_inside_enu_m
        return fields


TRACK_STEP_M = 0.5
"""Positions nearer than this to the logged one are not logged: a hover wanders by as much."""


class TrackMessages:
    """Remembers which position the log has."""

    def __init__(self) -> None:
        self._logged: PositionEnu | None = None

    def record(self, position_enu_m: PositionEnu | None) -> dict[str, object] | None:
        """Return the vehicle's position for the log; None: it is about the logged one."""
        if position_enu_m is None or (
            self._logged is not None and math.dist(position_enu_m, self._logged) < TRACK_STEP_M
        ):
            return None
        self._logged = position_enu_m
        return {"position_enu_m": tuple(round(each, 2) for each in position_enu_m)}


class MotionMessages:
    """What was told of each emitter."""

    def __init__(self) -> None:
        self._walking: set[int] = set()

    def messages_for(self, emitter_id: int, motion: TargetMotion | None) -> list[Announce]:
        """What is news, mostly nothing, of a target that walks, or lies still (None)."""
        is_walking, was_walking = motion is not None, emitter_id in self._walking
        if is_walking == was_walking:
            return []
        if motion is None:
            self._walking.remove(emitter_id)
            return [Announce(Severity.INFO, "target seems stationary again")]
        self._walking.add(emitter_id)
        pace = f"{motion.speed_mps:.1f} m/s"
        text = f"target seems to move at {pace}, or is shadowed"
        return [Announce(Severity.WARNING, text)]


AT_BOUND_SHARE = 0.01
"""Of the width between both bounds: so near the offset is held by one."""
MANY_FOR_OFFSET = 50
"""Accepted measurements after which an offset at its bound is no start any more."""


class OffsetMessages:
    """Announces a range offset that its bound holds: the radio's own one lies beyond."""

    def __init__(self) -> None:
        self._texts = Rarely(SAID_EVERY_S)

    def messages_for(
        self, offset_m: float, noise: FilterParams, accepted: int, now_s: float
    ) -> list[Announce]:
        """Return what to announce now.

        A bound of 0 is left out: a calibrated radio's offset lies there.
        """
        low_m, high_m = noise.range_offset_min_m, noise.range_offset_max_m
        if low_m is None or high_m is None or accepted < MANY_FOR_OFFSET:
            return []
        for bound_m in (low_m, high_m):
            is_held = abs(offset_m - bound_m) <= AT_BOUND_SHARE * (high_m - low_m)
            if bound_m and is_held and self._texts.is_due(bound_m, now_s):
                text = f"range offset is at its bound, {bound_m:+.3g} m: calibrate the radio"
                return [Announce(Severity.WARNING, text)]
        return []


ANTENNA_TEXTS: dict[str, str] = {
    "planar": "bearings are worthless from above: planar antenna? Set estimation.filter.antenna",
    "contradicted": "directions contradict the antenna as it is told: check its kind and mount_deg",
    "line": "bearings fit a line of antennas, no azimuth: set estimation.filter.antenna",
}


class AntennaMessages:
    """What was told of the antenna, each once."""

    def __init__(self) -> None:
        self._told: set[str] = set()

    def messages_for(self, shown: str | None) -> list[Command]:
        """What is news, mostly nothing, of what the directions show."""
        if shown is None or shown in self._told:
            return []
        self._told.add(shown)
        commands: list[Command] = [Record("antenna", {"kind": shown})]
        if shown in ANTENNA_TEXTS:
            commands.append(Announce(Severity.WARNING, ANTENNA_TEXTS[shown]))
        return commands


RECORD_PERIOD_S = 1.0
"""Refusals for one reason become a line of the log at most this often, with their number."""
MANY, MANY_WITHIN_S = 20, 10.0
"""So many for one reason within that time are worth a text."""
TEXT_PERIOD_S = 60.0
HARMLESS = frozenset({RejectReason.OTHER_EMITTER, RejectReason.DUPLICATE, RejectReason.OUT_OF_VIEW})
"""Reasons that say nothing against the radio."""


class RejectMessages:
    """Collects refusals."""

    def __init__(self) -> None:
        self._pending: Counter[RejectReason] = Counter()
        self._times_s: dict[RejectReason, deque[float]] = {}
        self._records, self._texts = Rarely(RECORD_PERIOD_S), Rarely(TEXT_PERIOD_S)

    def messages_for(self, reason: RejectReason, now_s: float) -> list[Command]:
        """A measurement was refused; what is to be told of it now."""
        self._pending[reason] += 1
        times_s = self._times_s.setdefault(reason, deque(maxlen=MANY))
        times_s.append(now_s)
        commands: list[Command] = []
        if self._records.is_due(reason, now_s):
            fields = {"reason": reason.value, "count": self._pending.pop(reason)}
            commands.append(Record("refused", fields))
        are_many = len(times_s) == MANY and now_s - times_s[0] <= MANY_WITHIN_S
        if are_many and reason not in HARMLESS and self._texts.is_due(reason, now_s):
            text = f"measurements rejected: {reason.value}; check the radio"
            commands.append(Announce(Severity.WARNING, text))
        return commands
