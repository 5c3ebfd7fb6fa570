"""The known emitters, and the current one among them.

Theory of operation. Every emitter that is heard gets a filter of its own, which learns from all its
measurements, whichever emitter is current: so the next one in turn is mostly known already. Plans,
reports and views are about the current one. On the ground it may change with every measurement; in
flight it stays until it is reported, or until it is silent while another one is heard: then it goes
to the end of the queue.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Annotated, ClassVar, Literal, NamedTuple

import msgspec

from companion.domain import Params, PositionEnu, RangingMeasurement
from companion.estimation.antenna import AntennaParams
from companion.estimation.belief import Belief
from companion.estimation.screen import RejectReason, reject_reason_of
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.geometry.polygons import Point
from companion.search.searched_area import SearchPrior

Order = Literal["first", "nearest", "strongest", "listed"]
EmitterId = Annotated[int, msgspec.Meta(ge=0, le=65535)]

LOST_S = 20.0
"""Silence after which the current emitter is replaced by one that is heard."""
MIN_ACCEPTED = 5
"""Measurements before an emitter can be compared with others."""
SMOOTHING = 0.1
"""Weight of the newest measurement in the mean of an emitter's strength."""


class QueueParams(Params, frozen=True):
    """Order in which several emitters are searched for."""

    order: Order = "first"
    """`first`: only the listed one, or the first one heard; else all of them, in this order."""
    listed: Annotated[tuple[EmitterId, ...], msgspec.Meta(max_length=16)] = ()
    """The ids, for `listed`, or the one for `first`; others are ignored."""
    most: ClassVar[int] = 8
    """Maximum number of filters without a list; emitters heard later are ignored."""

    def __post_init__(self) -> None:
        """Reject a list that `order` does not use, or the lack of one that it needs."""
        if self.order == "first" and len(self.listed) > 1:
            raise ValueError("order: first searches for one emitter, and listed for several ids")
        if self.order != "first" and (self.order == "listed") != bool(self.listed):
            raise ValueError("order: listed needs ids in `listed`; nearest and strongest need none")
        if len(set(self.listed)) < len(self.listed):
            raise ValueError("an id is listed twice")


class Progress(NamedTuple):
    """Emitters that were reported, heard, or neither."""

    reported: tuple[int, ...]
    heard: tuple[int, ...]
    """Heard and not reported."""
    sought: tuple[int, ...] | None
    """Ids not heard yet; empty: any further emitter; None if no other emitter is searched for."""


class EmitterQueue:
    """The filters of all emitters, and the current one.

    Where the order is `first`, only the listed one counts, or the first one heard. With
    `searches_on` a filter without an id becomes the current one after the last report: it waits for
    a further emitter, while those that were reported have no turn again.
    """

    def __init__(
        self,
        trackers: TrackerParams,
        params: QueueParams | None = None,
        *,
        searches_on: bool = False,
    ) -> None:
        self.params = QueueParams() if params is None else params
        self._searches_on = searches_on
        self.is_single = self.params.order == "first"
        """True if only one emitter counts."""
        self._tracker_params = trackers
        self._strengths: dict[int, float] = {}
        self.reported: set[int] = set()
        self.search_prior: Callable[[], SearchPrior | None] = lambda: None
        """Source of the prior of an emitter at its first measurement."""
        self._deferred: list[int] = []
        """Emitters that were current and were lost, oldest loss first."""
        self._sensor_en_m: Point = (0.0, 0.0)
        listed = {number: TargetTracker(trackers, number) for number in self.params.listed}
        self._trackers = {} if self.is_single else listed
        self.current = next(iter(listed.values()), TargetTracker(trackers))
        """Filter of the current emitter."""

    @classmethod
    def of(cls, tracker: TargetTracker) -> EmitterQueue:
        """Return a queue with one emitter."""
        queue = cls(tracker.params)
        queue.current = tracker
        return queue

    @property
    def antenna(self) -> AntennaParams:
        """Antenna that measures the bearings of all of them."""
        return self._tracker_params.filter.antenna

    @property
    def stamp_lag_s(self) -> float:
        """Delay of the radio's time stamps, in seconds."""
        return self._tracker_params.filter.stamp_lag_s

    @property
    def trackers(self) -> tuple[TargetTracker, ...]:
        """All filters, in the order in which the emitters were listed or heard."""
        return tuple(self._trackers.values()) or (self.current,)

    @property
    def accepted(self) -> int:
        """Number of fused measurements of all emitters."""
        return sum(tracker.accepted for tracker in self.trackers)

    @property
    def rejected(self) -> Counter[RejectReason]:
        """Number of rejected measurements, by reason."""
        counters = (tracker.rejected for tracker in self.trackers)
        return sum(counters, Counter[RejectReason]())

    @property
    def restarts(self) -> int:
        """Number of filters that were restarted."""
        return sum(tracker.integrity.restarts for tracker in self.trackers)

    def is_current(self, emitter_id: int) -> bool:
        """Return True if this emitter is the current one."""
        return self.current.emitter_id in ((None, emitter_id) if self.is_single else (emitter_id,))

    def tracker_of(self, emitter_id: int) -> TargetTracker:
        """Return the filter of an emitter that was heard."""
        return self._trackers[emitter_id]

    @property
    def are_all_reported(self) -> bool:
        """True if every listed or heard emitter is reported, where there may be several."""
        return not self._is_open and self.reported.issuperset(self._trackers)

    @property
    def progress(self) -> Progress:
        """Emitters that were reported, heard, or neither."""
        heard = [t.emitter_id for t in self.trackers if t.accepted or t.hypotheses]
        rest = tuple(n for n in heard if n is not None and n not in self.reported)
        sought: tuple[int, ...] | None = None if heard and not self._is_open else ()
        if self.params.listed:
            found = self.reported.union(rest)
            sought = tuple(n for n in self.params.listed if n not in found) or None
        return Progress(tuple(sorted(self.reported)), rest, sought)

    @property
    def _is_open(self) -> bool:
        """True if the search continues for further emitters after a report."""
        return self._searches_on and not self._is_full

    @property
    def waiting(self) -> list[int]:
        """Emitters that are not searched for yet, the next one first."""
        now = self.current.emitter_id
        rest = [n for n in self._trackers if n not in self.reported and n != now]
        return sorted(rest, key=self._rank)

    def addressed(
        self, measurement: RangingMeasurement, now_s: float
    ) -> TargetTracker | RejectReason:
        """Return the filter of an emitter, a new one if need be, or why it has none."""
        tracker = self._trackers.get(measurement.emitter_id)
        if tracker is not None:
            return tracker
        reason = reject_reason_of(measurement, now_s, self._tracker_params.acceptance)
        reason = RejectReason.OTHER_EMITTER if self._is_full else reason
        return reason or self._begin(measurement.emitter_id)

    def note_fused(self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu) -> None:
        """Note position and strength of a measurement among several emitters.

        Its strength is its power, else the radio's quality, else minus the range.
        """
        self._sensor_en_m = sensor_enu_m[:2]
        strength = measurement.power_dbm
        if strength is None:
            strength = measurement.quality
        if strength is None:
            range_m = measurement.range_m
            if range_m is None or not math.isfinite(range_m):
                return
            strength = -range_m
        before = self._strengths.get(measurement.emitter_id, strength)
        mean = (1.0 - SMOOTHING) * before + SMOOTHING * strength
        self._strengths[measurement.emitter_id] = mean

    def choose(self, now_s: float, *, is_flying: bool) -> None:
        """Choose the current emitter; in flight it stays if it can."""
        if self.is_single:
            return
        if is_flying:
            if not self._is_heard(self.current, now_s):
                self._defer(now_s)
            return
        open_ones = [n for n in self._trackers if n not in self.reported]
        if open_ones:
            self.current = self._trackers[min(open_ones, key=self._rank)]

    def restart(self) -> None:
        """Drop all estimates, because the frame may have moved."""
        for tracker in self.trackers:
            tracker.restart()

    def report_current(self) -> bool:
        """Mark the current emitter as reported, go to the next; return False if none is left."""
        if self.is_single or self.current.emitter_id is None:
            return False
        return self.mark_reported([self.current.emitter_id])

    def mark_reported(self, ids: Iterable[int]) -> bool:
        """Mark emitters as reported, and leave the current one if it is; False if none is left."""
        self.reported.update(ids)
        if self.current.emitter_id not in self.reported:
            return True
        following = self.waiting
        if following:
            self.current = self._trackers[following[0]]
        elif self._is_open:
            self.current = TargetTracker(self._tracker_params)
        else:
            return False
        return True

    def resume(self, belief: Belief, age_s: float, now_s: float) -> str | None:
        """Restore the estimate of one emitter, which becomes the current one unless it is reported.

        Returns None, or the reason why that is impossible; nothing is changed then.
        """
        if self.is_single:
            return self.current.resume(belief, age_s, now_s)
        emitter_id = belief.emitter_id
        if emitter_id is None:
            return "an emitter without an id"
        tracker = self._trackers.get(emitter_id)
        if tracker is None:
            if self._is_full:
                return "another emitter"
            tracker = self._begin(emitter_id)
        if not (self._is_open and emitter_id in self.reported):
            self.current = tracker
        return tracker.resume(belief, age_s, now_s)

    @property
    def _is_full(self) -> bool:
        return bool(self.params.listed) or len(self._trackers) >= self.params.most

    def _begin(self, emitter_id: int) -> TargetTracker:
        """Return a filter for another emitter: the current one if that waits for it."""
        is_awaited = self.current.emitter_id is None and emitter_id not in self.reported
        tracker = self.current if is_awaited else TargetTracker(self._tracker_params)
        tracker.emitter_id = emitter_id
        self._trackers[emitter_id] = tracker
        return tracker

    def _defer(self, now_s: float) -> None:
        """Queue the lost emitter behind those that are heard, if there are any."""
        lost = self.current.emitter_id
        heard = [n for n in self.waiting if self._is_heard(self._trackers[n], now_s)]
        if lost is None or not heard:
            return
        self._deferred = [*(n for n in self._deferred if n != lost), lost]
        self.current = self._trackers[heard[0]]

    @staticmethod
    def _is_heard(tracker: TargetTracker, now_s: float) -> bool:
        heard_s = tracker.last_accepted_s
        return heard_s is not None and now_s - heard_s <= LOST_S

    def _rank(self, emitter_id: int) -> tuple[int, bool, float]:
        """Return the sort key: those never lost first, then those that can be compared."""
        tracker = self._trackers[emitter_id]
        lost = self._deferred.index(emitter_id) + 1 if emitter_id in self._deferred else 0
        is_vague = tracker.accepted < MIN_ACCEPTED
        match self.params.order:
            case "nearest":
                value = self._distance_m(tracker)
            case "strongest":
                value = -self._strengths.get(emitter_id, -math.inf)
            case _:
                order = self.params.listed or tuple(self._trackers)
                value = float(order.index(emitter_id))
        return lost, is_vague, value

    def _distance_m(self, tracker: TargetTracker) -> float:
        if not tracker.hypotheses:
            return math.inf
        east, north = tracker.hypotheses[0].state.mean[:2]
        return math.dist(self._sensor_en_m, (float(east), float(north)))
