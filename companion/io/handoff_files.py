"""What a flight leaves for ground teams: every emitter found as GeoJSON, KML and MGRS text."""

from __future__ import annotations

from companion.guidance.commands import ReportResult
from companion.handoff.geojson import geojson
from companion.handoff.grid import mgrs_text
from companion.handoff.kml import kml
from companion.handoff.record import Handoff, handoff_of

GEOJSON, KML, TEXT = "handoff.geojson", "handoff.kml", "handoff.txt"


class HandoffFiles:
    """Keeps the newest hand-off of every emitter."""

    def __init__(self) -> None:
        self._handoffs: dict[str, Handoff] = {}

    def files(self, report: ReportResult, unix_s: float) -> dict[str, str]:
        """The files' contents after a report, by name; none without an origin.

        Args:
            report: Of one emitter.
            unix_s: Wall clock of the report.
        """
        if report.origin is None:
            return {}
        emitter = "unknown" if report.emitter_id is None else str(report.emitter_id)
        self._handoffs[emitter] = handoff_of(emitter, report.estimate, report.origin, unix_s)
        handoffs = list(self._handoffs.values())
        return {
            GEOJSON: geojson(handoffs),
            KML: kml(handoffs),
            TEXT: "".join(_line(handoff) for handoff in handoffs),
        }


def _line(handoff: Handoff) -> str:
    """One emitter in one line, to be read out over the radio."""
    latitude_deg, longitude_deg = handoff.place_deg
    grid = mgrs_text(handoff.place_deg, handoff.r95_m)
    return (
        f"emitter {handoff.emitter}: {grid}  ({latitude_deg:.6f}, {longitude_deg:.6f}), "
        f"R95 {handoff.r95_m:.1f} m, {handoff.state}, {handoff.time_utc}\n"
    )
