"""What the event log says of an estimate and of a waypoint."""

from __future__ import annotations

from dataclasses import asdict

from companion.domain import TargetEstimate, Waypoint
from companion.estimation.tracker import FusionReport, TargetTracker
from companion.geometry.frames import LocalOrigin
from companion.guidance.commands import Record, ReportResult


def estimate_record(report: FusionReport, estimate: TargetEstimate) -> Record:
    """The estimate after a measurement, with the innovations that led to it."""
    fields: dict[str, object] = {
        "state": estimate.state.value,
        "position_enu_m": estimate.position_enu_m,
        "covariance_m2": estimate.covariance_m2,
        "alternative_enu_m": estimate.alternative_enu_m,
        "r95_m": estimate.r95_m,
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
        "r95_m": estimate.r95_m,
        "measurements": estimate.measurements,
    }
    return Record("waiting", fields)


def health_fields(tracker: TargetTracker, now_s: float) -> dict[str, object]:
    """How far the estimate can be trusted, as live values."""
    objection, contact = tracker.objection(now_s), tracker.contact
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
    """The result of the flight, and the operator's text about it.

    Args:
        estimate: Where the target is.
        origin: Zero of the local frame; without it there are no degrees to tell.
        target_height_m: Of the target in the local frame.
        emitter_id: Which emitter it is.
        head: What the text begins with.
    """
    r95 = f"R95 {estimate.r95_m:.1f} m"
    if origin is None:
        return ReportResult(estimate, None, None, emitter_id), f"{head} {r95}"
    place = (*estimate.position_enu_m, target_height_m)
    latitude_deg, longitude_deg, _ = origin.geodetic_from_enu(place)
    text = f"{head} {latitude_deg:.7f} {longitude_deg:.7f} {r95}"
    return ReportResult(estimate, latitude_deg, longitude_deg, emitter_id, origin), text
