"""Area searched by the radio since take-off, for emitters that were not heard.

All of them share one map, because it is the same for every emitter that was not heard. Counting
ends once no such emitter is left: in a search for one emitter at the first accepted measurement.

Time under the pilot's control is included, because the radio listens then, too. It is counted while
the vehicle is in the air with a current, trusted position. Positions are kept in the frame of the
first origin. The work on the cells is done in pieces, one a control tick.
"""

from __future__ import annotations

import math

from companion.domain import LandedState, PositionEnu
from companion.geometry.coordinates import LocalOrigin
from companion.geometry.polygons import Corners, Point
from companion.guidance.emitters import Progress
from companion.guidance.vehicle import VehicleView
from companion.search.detection_model import DetectionModel
from companion.search.outlook import Outlook, outlook_of
from companion.search.search_grid import (
    SearchGrid,
    SearchSite,
    WeightedArea,
    grid_of_site,
    grid_over,
    share_outside,
)
from companion.search.searched_area import (
    LearntReach,
    SearchedArea,
    SearchPrior,
    SearchState,
    learnt_reach,
)
from companion.search.searched_flight import SearchAreaParams, SearchedFlight, StoredGrid, statement

LONGEST_GAP_S = 1.0
"""Longest pause between two control ticks that still counts as searched."""
TRACK_STEP_M = 5.0
WORTH_REPORTING_S = 10.0
"""Time before contact below which a flight does not count as a search."""
WORTH_REPORTING_SHARE = 0.01
"""Probability outside of the fence above which the operator is warned."""
STATE_EVERY_S = 2.0
"""Time between two updates of the probabilities."""


class Searching:
    """Accumulates the searched area of one flight; without a detection model only its track."""

    def __init__(
        self,
        params: SearchAreaParams | None = None,
        detection: DetectionModel | None = None,
        site: SearchSite | None = None,
        *,
        is_planned: bool = False,
    ) -> None:
        self.params = params or SearchAreaParams()
        self._detection = detection
        """`params.detection` with a reach."""
        self._is_planned = is_planned
        """True if the planner uses the remaining probability."""
        self._site = site
        self._area: SearchedArea | None = None
        self._origin: LocalOrigin | None = None
        self._laid_for: tuple[LocalOrigin | None, Corners | None] = (None, None)
        """Origin and fence that the grid is for; it is laid on the ground."""
        self._ticked_s = -math.inf
        self._began_s: float | None = None
        self._track: list[tuple[float, float, float, float]] = []
        self._stored_grid: StoredGrid | None = None
        self.state: SearchState | None = None
        """State of the search, a few seconds old at most, by control ticks alone, so that a replay
        has the same; None if there is no grid."""
        self._renewed_s = -math.inf
        self._is_final = False
        """True if the state contains everything that counts."""
        self._outlook: Outlook | None = None
        self.listened_s = 0.0
        """Time in the air that counts."""
        self.ended_s = 0.0
        """Time of the last position that counted."""
        self.contact_id: int | None = None
        self._contact_m: PositionEnu | None = None
        """Vehicle position at contact, in the frame of the grid; up is above the ground."""
        self._learnt: LearntReach | None = None
        self.contact_s: float | None = None
        """Time of the first accepted measurement."""
        self.is_radio_heard = False
        """True if the radio has sent anything at all."""
        self.is_counting = True
        """False once no emitter is left that was not heard."""
        self.is_over = False
        """True if nothing is counted any more, and all work on the cells is done."""
        self.progress = Progress((), (), ())

    @property
    def is_worth_reporting(self) -> bool:
        """True if the search lasted long enough to be reported."""
        return self.listened_s >= WORTH_REPORTING_S

    @property
    def frame(self) -> LocalOrigin | None:
        """Origin of the frame of the grid; None: not known yet."""
        return self._origin

    def tick(
        self,
        now_s: float,
        vehicle: VehicleView,
        fence_enu_m: Corners | None,
        progress: Progress,
    ) -> str | None:
        """Count the time since the last control tick; return a warning, once, or None."""
        problem = self._listen(now_s, vehicle, fence_enu_m, progress)
        self.is_over = not self.is_counting and (self._area is None or self._is_final)
        return problem

    def _listen(
        self,
        now_s: float,
        vehicle: VehicleView,
        fence_enu_m: Corners | None,
        progress: Progress,
    ) -> str | None:
        passed_s, self._ticked_s = now_s - self._ticked_s, now_s
        self.progress = progress
        problem = None
        if self._area is not None:
            area = self._area
            if now_s - self._renewed_s < STATE_EVERY_S:
                area.advance()
            elif area.renew():
                self._renewed_s = now_s
                self._is_final = not self.is_counting and not area.has_work
                self.state, self._outlook = area.state, None
        if self._began_s is None:
            self._origin = vehicle.frame
        if self._began_s is None or self._area is None:
            problem = self._begin(fence_enu_m)
        if progress.heard and self.contact_s is None:
            self.contact_s, self.contact_id = now_s, progress.heard[0]
            self._note_contact(vehicle)
        self.is_counting = self.is_counting and progress.sought is not None
        position_enu_m, height_m = vehicle.position_enu_m, vehicle.height_m
        is_airborne = vehicle.is_armed and vehicle.landed is LandedState.IN_AIR
        is_trusted = vehicle.is_position_fresh(now_s) and vehicle.track.is_trusted_at(now_s)
        if not (self.is_counting and is_airborne and is_trusted):
            return problem
        if position_enu_m is None or height_m is None or passed_s > LONGEST_GAP_S:
            return problem
        if self._began_s is None:
            self._began_s = now_s
        self._count(now_s, passed_s, (*self._in_first_frame(position_enu_m, vehicle)[:2], height_m))
        return problem

    def _note_contact(self, vehicle: VehicleView) -> None:
        position_enu_m, height_m = vehicle.position_enu_m, vehicle.height_m
        if position_enu_m is not None and height_m is not None and self._area is not None:
            self._contact_m = (*self._in_first_frame(position_enu_m, vehicle)[:2], height_m)
            self._area.note_contact()

    def learn(self, emitter_id: int | None, emitter_enu_m: Point, vehicle: VehicleView) -> None:
        """Learn the reach from the position of the emitter that was heard first, once reported."""
        if self._area is None or self._contact_m is None or self._learnt is not None:
            return
        if emitter_id != self.contact_id or not self.is_worth_reporting:
            return
        self._area.finish()
        found_m = self._in_first_frame((*emitter_enu_m, 0.0), vehicle)
        self._learnt = learnt_reach(self._area, self._contact_m, found_m[:2])

    def _count(self, now_s: float, passed_s: float, position_m: PositionEnu) -> None:
        assert self._began_s is not None
        self.listened_s += passed_s
        self.ended_s = now_s
        if not self._track or math.dist(position_m, self._track[-1][1:]) >= TRACK_STEP_M:
            self._track.append((round(now_s - self._began_s, 2), *_rounded(position_m)))
        if self._area is not None:
            self._area.listen(position_m, passed_s)

    def _in_first_frame(self, position_enu_m: PositionEnu, vehicle: VehicleView) -> PositionEnu:
        frame, first = vehicle.frame, self._origin
        if frame is None or first is None or frame == first:
            return position_enu_m
        return first.enu_from_geodetic(*frame.geodetic_from_enu(position_enu_m))

    def _begin(self, fence_enu_m: Corners | None) -> str | None:
        """Make the grid; return the reason if that is impossible, else None."""
        detection = self._detection
        if detection is None:
            return None
        laid_for = (self._origin, fence_enu_m)
        if laid_for == self._laid_for:
            return None
        self._laid_for, self._area = laid_for, None
        try:
            grid = self._grid(fence_enu_m)
        except ValueError as error:
            return f"no searched area: {error}"
        if grid is None:
            return None
        self._area, self._stored_grid = SearchedArea(grid, detection), StoredGrid.of(grid)
        self.state = self._area.state
        outside = 0.0 if fence_enu_m is None else share_outside(grid, fence_enu_m)
        if outside < WORTH_REPORTING_SHARE:
            return None
        return f"{100.0 * outside:.0f} % of the search area's probability is outside the fence"

    def _grid(self, fence_enu_m: Corners | None) -> SearchGrid | None:
        if self._site is not None:
            if self._origin is None:
                return None
            return grid_of_site(self._site, self._origin, self.params.cell_m, fence_enu_m)
        if fence_enu_m is None:
            return None
        return grid_over([WeightedArea(tuple(fence_enu_m))], self.params.cell_m)

    def outlook(self, vehicle: VehicleView) -> Outlook | None:
        """Return the remaining probability, at most seconds old; None: unknown.

        None also once counting has ended, or if the local frame has moved since the grid was made.
        """
        if self._area is None or not self._is_planned or not self.is_counting:
            return None
        if vehicle.frame != self._origin:
            return None
        if self._outlook is None:
            self._outlook = outlook_of(self._area)
        return self._outlook

    def prior(self, frame: LocalOrigin | None) -> SearchPrior | None:
        """Return where the emitter may be, at contact; None if nothing is known in this frame."""
        if self.state is None or not self.is_worth_reporting or frame != self._origin:
            return None
        return SearchPrior.of(self.state)

    def finish(self) -> None:
        """Complete all work on the cells, at the end of the flight."""
        if self._area is not None:
            self._area.finish()
            self.state = self._area.state

    def end(self, sweeps: int) -> str | None:
        """Return the reason to end a pattern search; None to continue."""
        params = self.params
        if not self.is_counting or not self.is_worth_reporting:
            return None
        if params.stop_sweeps is not None and sweeps >= params.stop_sweeps:
            return "the area is done"
        if params.stop_pos is None:
            return None
        if self.state is None or self.state.pos < params.stop_pos:
            return None
        return f"POS {100.0 * self.state.pos:.0f} % reached"

    def statement(self) -> str | None:
        """Return the searched area in the sentence for the radio, or None without a state."""
        flight = self.flight(0.0)
        return None if flight is None or self.state is None else statement(flight, self.state)

    def flight(self, zero_unix_s: float) -> SearchedFlight | None:
        """Return the record of this flight, or None if there was no search worth reporting."""
        if self._began_s is None or not self.is_worth_reporting:
            return None
        looks = [] if self._area is None else self._area.looks
        detection = self.params.detection
        is_preset = detection is not None and detection.reach_m is None
        return SearchedFlight(
            began_unix_s=zero_unix_s + self._began_s,
            ended_unix_s=zero_unix_s + self.ended_s,
            listened_s=round(self.listened_s, 2),
            contact_unix_s=None if self.contact_s is None else zero_unix_s + self.contact_s,
            reported=self.progress.reported,
            heard=self.progress.heard,
            sought=self.progress.sought if self.is_counting else None,
            is_radio_heard=self.is_radio_heard,
            origin=self._origin,
            detection=self._detection,
            reach_from="preset" if is_preset else "configured",
            learnt=self._learnt,
            grid=self._stored_grid,
            looks=[(*_rounded(look.position_m), round(look.answers, 3)) for look in looks],
            track=list(self._track),
        )


def _rounded(position_m: PositionEnu) -> PositionEnu:
    return (round(position_m[0], 2), round(position_m[1], 2), round(position_m[2], 2))
