"""What the flight report needs: the true track and the mode changes."""

from __future__ import annotations

from companion.domain import FlightMode
from sim_link.autopilot.vehicle import STEP_S, Occurrence, SimVehicle

TRACK_PERIOD_S = 0.5
MAX_OCCURRENCES = 10_000
"""A report of a flight that flaps for days stays readable, and the memory bounded."""
MAX_TRACK_POINTS = 7_200
"""An hour at first; beyond it every other point is dropped, and half as many follow."""


class FlightRecorder:
    """Collects while the vehicle is stepped."""

    def __init__(self) -> None:
        self.track: list[tuple[float, float, float, float]] = []
        """Seconds since boot and true east, north and up, metres, of the whole flight."""
        self.mode_changes: list[Occurrence] = []
        self._mode = FlightMode.HOLD
        self._track_due_s = 0.0
        self._period_s = TRACK_PERIOD_S
        self._fresh: list[Occurrence] = []

    def take(self, vehicle: SimVehicle) -> None:
        """Take over what happened up to the vehicle's present step."""
        if vehicle.time_s + 0.5 * STEP_S >= self._track_due_s:
            self.track.append((vehicle.time_s, *vehicle.body.position_enu_m))
            if len(self.track) > MAX_TRACK_POINTS:
                self.track = self.track[::2]
                self._period_s *= 2.0
            self._track_due_s = max(self._track_due_s, vehicle.time_s) + self._period_s
        for occurrence in vehicle.occurrences:
            self._fresh = [*self._fresh[-MAX_OCCURRENCES:], occurrence]
            if occurrence.mode is not self._mode and len(self.mode_changes) < MAX_OCCURRENCES:
                self.mode_changes.append(occurrence)
            self._mode = occurrence.mode
        vehicle.occurrences.clear()

    def take_occurrences(self) -> list[Occurrence]:
        """The occurrences since the last call."""
        fresh, self._fresh = self._fresh, []
        return fresh
