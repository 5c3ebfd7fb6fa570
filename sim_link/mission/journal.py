"""The companion's event log, read as it is written: in memory, or line by line from its file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from companion.domain import Point
from companion.guidance.authority.state_machine import IN_CONTROL
from companion.guidance.commands import ReportResult, Severity
from sim_link.mission.record import EstimatePoint, FlightRecord, Report, Said
from sim_link.mission.situation import Situation

CONTROL_PHASES = frozenset(phase.value for phase in IN_CONTROL)


class EventReader:
    """Turns events of the companion into the record of the flight and the present situation.

    It is a companion's `Journal`, so that a companion in memory writes straight into it.

    Args:
        record: Grows.
        situation: Is kept up to date.
        emitters: The true places, by id.
        first_emitter: Whose estimate an event is that names no emitter.
    """

    def __init__(
        self,
        record: FlightRecord,
        situation: Situation,
        emitters: Mapping[int, Point],
        first_emitter: int,
    ) -> None:
        self._record = record
        self._situation = situation
        self._emitters = emitters
        self._first_emitter = first_emitter
        self._ranging_heard_s: float | None = None

    # What a companion in memory calls

    def frame(self, data: bytes, now_s: float) -> None:
        """Frames are watched on the wire."""

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """An event."""
        self.take(kind, fields, now_s)

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        """A text for the operator."""
        self.take("text", {"severity": severity.name.lower(), "text": text}, now_s)

    def result(self, report: ReportResult, now_s: float) -> None:
        """A target that was found."""
        estimate = report.estimate
        east_m, north_m = estimate.position_enu_m
        fields = {
            "emitter_id": report.emitter_id,
            "east_m": east_m,
            "north_m": north_m,
            "r95_m": estimate.r95_m,
        }
        self.take("result", fields, now_s)

    # What both lead to

    def take(self, kind: str, fields: Mapping[str, Any], time_s: float) -> None:
        """Take in an event at a time since the mission began."""
        self._record.events.append((time_s, kind, fields))
        match kind:
            case "estimate":
                self._take_estimate(fields, time_s)
            case "refused":
                self._situation.companion.refused += int(fields["count"])
            case "phase":
                self._enter(fields["new"], time_s)
            case "bound" if self._situation.companion.phase is None:
                self._enter("waiting", time_s)
            case "text":
                self._record.texts.append(Said(time_s, "companion", fields["text"]))
                self._situation.companion_texts.append(fields["text"])
            case "waypoint":
                self._situation.companion.waypoint = fields["reason"]
                place = _point(fields["position_enu_m"])
                self._record.waypoints.append((time_s, place, fields["reason"]))
            case "result":
                self._take_result(fields, time_s)

    def age(self, now_s: float) -> None:
        """Let what ages grow older."""
        if self._ranging_heard_s is not None:
            self._situation.companion.ranging_age_s = now_s - self._ranging_heard_s

    def restarted(self) -> None:
        """The companion's process ended: what it said of itself is over."""
        companion = self._situation.companion
        companion.phase = companion.is_in_control = companion.waypoint = None

    def _enter(self, phase: str, time_s: float) -> None:
        companion = self._situation.companion
        companion.phase = phase
        companion.is_in_control = phase in CONTROL_PHASES
        self._record.phases.append((time_s, phase))
        if companion.is_in_control and self._record.engaged_s is None:
            self._record.engaged_s = time_s

    def _take_estimate(self, fields: Mapping[str, Any], time_s: float) -> None:
        self._ranging_heard_s = time_s
        self._situation.companion.measurements += 1
        emitter = fields.get("emitter_id", self._first_emitter)
        place = _point(fields["position_enu_m"])
        point = EstimatePoint(
            time_s=time_s,
            emitter=emitter,
            state=fields["state"],
            position_enu_m=place,
            r95_m=fields["r95_m"],
            range_innovation_m=fields.get("range_innovation"),
            bearing_innovation_rad=fields.get("bearing_innovation"),
        )
        self._record.estimates.append(point)
        seen, truth = self._situation.estimate, self._emitters.get(emitter)
        seen.emitter, seen.state, seen.r95_m = emitter, point.state, point.r95_m
        seen.east_m, seen.north_m = place
        seen.error_m = None if truth is None else math.dist(place, truth)
        seen.range_offset_m = fields["range_offset_m"]
        seen.bearing_offset_deg = math.degrees(fields["bearing_offset_rad"])

    def _take_result(self, fields: Mapping[str, Any], time_s: float) -> None:
        emitter = fields.get("emitter_id")
        if emitter is None:
            emitter = self._situation.estimate.emitter
        place = (float(fields["east_m"]), float(fields["north_m"]))
        self._record.reports.append(Report(time_s, emitter, place, fields["r95_m"]))
        self._situation.companion.reported += 1


def _point(value: Any) -> Point:
    east, north = value
    return (float(east), float(north))
