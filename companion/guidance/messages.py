"""Rate-limited texts for the operator, and records for the event log.

Theory of operation of findings. An announced state stays valid for the operator until it has been
over for a while, or a worse one begins: then the new state is announced. A reason that was not
announced for long is announced at once. So two reasons that alternate at every tick are announced
once each, and a lasting one at the latest a moment after it began. A lost link never waits: it ends
only after a second, so it cannot flicker.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Hashable
from dataclasses import asdict, replace

from companion.domain import EstimateState, TargetEstimate, Waypoint, radii_text
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.screen import RejectReason
from companion.estimation.target_motion import TargetMotion
from companion.estimation.tracker import FusionReport, TargetTracker
from companion.geometry.coordinates import LocalOrigin
from companion.guard.gate import GuardReason
from companion.guard.limits import Fence
from companion.guidance.commands import Announce, Command, Record, ReportResult, Severity


def radius_fields(estimate: TargetEstimate) -> dict[str, object]:
    """Return both radii, and the vehicle position's sigma in the absolute one with its source."""
    return {
        "r95_m": estimate.r95_m,
        "absolute_r95_m": estimate.absolute_r95_m,
        "own_sigma_m": estimate.own.horizontal_m,
        "own_sigma_told": estimate.own.is_reported,
    }


def radii_of(estimate: TargetEstimate) -> str:
    """Return the text of both radii."""
    return radii_text(estimate.absolute_r95_m, estimate.r95_m)


def radius_texts(estimate: TargetEstimate) -> list[str]:
    """Return both radii, and the GNSS accuracy in the absolute one if it is an assumed one."""
    own, texts = estimate.own, [radii_of(estimate)]
    if not own.is_reported:
        texts.append(f"GNSS accuracy not reported: assuming {own.horizontal_m:.3g} m")
    return texts


def estimate_record(report: FusionReport, estimate: TargetEstimate) -> Record:
    """Return the record of the estimate after a measurement, with its innovations."""
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
    """Return the record of the estimate of an emitter that is not searched for now."""
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
    """Return indicators of trust in the estimate as live values."""
    objection, contact = tracker.objection(now_s), tracker.integrity.contact
    return {
        **asdict(tracker.health),
        "objection": None if objection is None else objection.value,
        "range_age_s": contact.range_age_s(now_s),
        "bearing_age_s": contact.bearing_age_s(now_s),
        "agreeing": contact.agreeing_since_gap(now_s),
    }


def waypoint_record(waypoint: Waypoint) -> Record:
    """Return the record of a waypoint and the reason for it."""
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
    """Return the result of the flight, in degrees where the origin is known, and its text.

    The radius is the absolute one, because readers may be anywhere on the Earth.
    """
    if origin is None:
        text = f"{head} R95 {estimate.absolute_r95_m:.1f} m"
        return ReportResult(estimate, None, None, emitter_id), text
    target_enu_m = (*estimate.position_enu_m, target_height_m)
    latitude_deg, longitude_deg, _ = origin.geodetic_from_enu(target_enu_m)
    text = f"{head} {latitude_deg:.7f} {longitude_deg:.7f} R95 {estimate.absolute_r95_m:.1f} m"
    return ReportResult(estimate, latitude_deg, longitude_deg, emitter_id, origin), text


class RateLimited:
    """Limits the rate of each text or record."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._announced_s: dict[Hashable, float] = {}

    def is_due(self, what: Hashable, now_s: float) -> bool:
        """Return True if an item is due now; it is then recorded as sent."""
        announced_s = self._announced_s.get(what)
        if announced_s is not None and now_s - announced_s < self._period_s:
            return False
        self._announced_s[what] = now_s
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

    A second position whose probability is near the threshold appears and vanishes with every
    measurement. So a state that demands more caution is announced at once, and one that demands
    less when the other has not been seen for `settle_s`. The estimate itself, and every decision
    made with it, keeps the current state.
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
        """Return True if the state of a new estimate is due; it is then recorded as announced."""
        state = self.shown(estimate, now_s, settle_s).state
        is_new = state is not self._announced
        if state is estimate.state:
            self._announced, self._seen_s = state, now_s
        return is_new


REPEAT_AFTER_S = 30.0
"""Shortest time between two texts with the same reason."""
LOGGED_EVERY_S = 1.0
SILENT = frozenset({GuardReason.LAGGING, GuardReason.CUT_OFF})
"""Reasons that recur at every corner, and are therefore only logged."""


class GuardMessages:
    """Rate-limits the guard's texts and records."""

    def __init__(self) -> None:
        self._texts = RateLimited(REPEAT_AFTER_S)
        self.logged: tuple[GuardReason, ...] = ()
        """Reasons in the log, as last recorded."""
        self._logged_s: float | None = None

    def texts(self, reasons: tuple[GuardReason, ...], now_s: float) -> list[str]:
        """Return texts for the reasons that were not announced for a while."""
        announced = [reason for reason in reasons if reason not in SILENT]
        return [
            f"guard: {reason.value}" for reason in announced if self._texts.is_due(reason, now_s)
        ]

    def record(self, reasons: tuple[GuardReason, ...], now_s: float) -> list[str] | None:
        """Return the reasons for the log if they changed and are not too frequent, else None."""
        is_soon = self._logged_s is not None and now_s - self._logged_s < LOGGED_EVERY_S
        if reasons == self.logged or is_soon:
            return None
        self.logged, self._logged_s = reasons, now_s
        return [reason.name.lower() for reason in reasons]


class FenceMessages:
    """Records changes of the guard's fence."""

    def __init__(self) -> None:
        self.logged: Fence | None = None

    def record(self, fence: Fence | None) -> dict[str, object] | None:
        """Return the fence for the log, null for none; None if it is the logged one."""
        before, self.logged = self.logged, fence
        if fence == before:
            return None
        fields: dict[str, object] = {
            "polygon_enu_m": None if fence is None else fence.polygon_enu_m,
            "keep_out_enu_m": () if fence is None else fence.keep_out_enu_m,
            "margin_m": None if fence is None else fence.margin_m,
        }
        if fence is not None and fence.also_inside_enu_m:
            fields["also_inside_enu_m"] = fence.also_inside_enu_m
        return fields


class MotionMessages:
    """Announces targets that begin or stop moving."""

    def __init__(self) -> None:
        self._walking: set[int] = set()

    def messages_for(self, emitter_id: int, motion: TargetMotion | None) -> list[Announce]:
        """Return a text if a target began to move, or became stationary (None); mostly none."""
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
"""Distance from a bound, as a share of the width, within which it limits the offset."""
MANY_FOR_OFFSET = 50
"""Accepted measurements after which an offset at its bound is no longer a starting value."""


class OffsetMessages:
    """Announces a range offset at its bound: the true one is probably beyond it."""

    def __init__(self) -> None:
        self._texts = RateLimited(REPEAT_AFTER_S)

    def messages_for(
        self, offset_m: float, noise: FilterParams, accepted: int, now_s: float
    ) -> list[Announce]:
        """Return the texts due now; a bound of 0 is left out, where a calibrated offset lies."""
        low_m, high_m = noise.range_offset_min_m, noise.range_offset_max_m
        if low_m is None or high_m is None or accepted < MANY_FOR_OFFSET:
            return []
        for bound_m in (low_m, high_m):
            is_held = abs(offset_m - bound_m) <= AT_BOUND_SHARE * (high_m - low_m)
            if bound_m and is_held and self._texts.is_due(bound_m, now_s):
                text = f"range offset at limit {bound_m:+.3g} m: calibrate the radio"
                return [Announce(Severity.WARNING, text)]
        return []


ANTENNA_TEXTS: dict[str, str] = {
    "planar": "bearings unusable from above: planar antenna? Set estimation.filter.antenna",
    "contradicted": "bearings inconsistent with the configured antenna: check kind and mount_deg",
    "line": "bearings fit a linear array, no azimuth: set estimation.filter.antenna",
}


class AntennaMessages:
    """Announces the antenna kind that the bearings show, each kind once."""

    def __init__(self) -> None:
        self._announced: set[str] = set()

    def messages_for(self, shown: str | None) -> list[Command]:
        """Return a record, and perhaps a text, if the bearings show another antenna kind."""
        if shown is None or shown in self._announced:
            return []
        self._announced.add(shown)
        commands: list[Command] = [Record("antenna", {"kind": shown})]
        if shown in ANTENNA_TEXTS:
            commands.append(Announce(Severity.WARNING, ANTENNA_TEXTS[shown]))
        return commands


RECORD_PERIOD_S = 1.0
"""Refusals for one reason become a line of the log at most this often, with their number."""
MANY, MANY_WITHIN_S = 20, 10.0
"""Number of refusals for one reason within that time that makes a text due."""
TEXT_PERIOD_S = 60.0
HARMLESS = frozenset(
    {
        RejectReason.OTHER_EMITTER,
        RejectReason.DUPLICATE,
        RejectReason.OUT_OF_VIEW,
        RejectReason.OWN_JUMP,
    }
)
"""Reasons that are not the radio's fault; a jump of the vehicle has its own text."""
OWN_STATE = frozenset({RejectReason.NO_POSITION, RejectReason.NO_YAW, RejectReason.NO_ATTITUDE})
"""Reasons for which the autopilot's telemetry is missing or late: stamps are checked before."""


class RejectMessages:
    """Collects refusals of measurements, by reason."""

    def __init__(self) -> None:
        self._pending: Counter[RejectReason] = Counter()
        self._times_s: dict[RejectReason, deque[float]] = {}
        self._records, self._texts = RateLimited(RECORD_PERIOD_S), RateLimited(TEXT_PERIOD_S)

    def messages_for(self, reason: RejectReason, now_s: float) -> list[Command]:
        """Count a refused measurement, and return the record and the text that are due."""
        self._pending[reason] += 1
        times_s = self._times_s.setdefault(reason, deque(maxlen=MANY))
        times_s.append(now_s)
        commands: list[Command] = []
        if self._records.is_due(reason, now_s):
            fields = {"reason": reason.value, "count": self._pending.pop(reason)}
            commands.append(Record("refused", fields))
        are_many = len(times_s) == MANY and now_s - times_s[0] <= MANY_WITHIN_S
        if are_many and reason not in HARMLESS and self._texts.is_due(reason, now_s):
            remedy = "check rates and link" if reason in OWN_STATE else "check the radio"
            text = f"measurements rejected: {reason.value}; {remedy}"
            commands.append(Announce(Severity.WARNING, text))
        return commands
