"""How well the vehicle knows its own place on the Earth: what is told, and what is counted.

Theory of operation. The receiver tells the accuracy of its fix. PX4's estimator tells one as well,
but about the local origin: slow errors of the satellites, which move the origin along with
everything else, are not in it. So it can make the receiver's worse and does not stand for it. Where
the receiver tells nothing, because it does not know, has no fix or is not heard any more, the own
place counts as known to `UNTOLD_SIGMA_M` at best, and that is called not told.

Source: GPS_RAW_INT.h_acc and v_acc, MAVLink common; PX4 1.15, EKF2, where
ESTIMATOR_STATUS.pos_horiz_accuracy comes from the accuracy of the local position.
"""

from __future__ import annotations

from companion.domain import HEIGHT_RATIO, UNTOLD, OwnAccuracy
from companion.guidance import events
from companion.guidance.events import OwnPlaceRated, PlaceTeller

HEARD_S = 5.0
"""What was told longer ago is not told; and so long a receiver that was never heard may take."""


class OwnPlaceWatch:
    """Remembers what was told last, by whom."""

    def __init__(self) -> None:
        self._receiver: OwnPlaceRated | None = None
        """What it told last, known or not."""
        self._horizontal_m: dict[PlaceTeller, float] = {}
        """What each knew last: who knows nothing any more has not become better by that."""
        self._vertical_m: dict[PlaceTeller, float] = {}
        self._begun_s: float | None = None
        """When the vehicle told its place first."""

    def handle(self, event: events.Event) -> None:
        """Take in what concerns the own place; other events change nothing."""
        match event:
            case OwnPlaceRated():
                if event.teller is PlaceTeller.RECEIVER:
                    self._receiver = event
                if event.horizontal_m is not None:
                    self._horizontal_m[event.teller] = event.horizontal_m
                if event.vertical_m is not None:
                    self._vertical_m[event.teller] = event.vertical_m
            case events.VehicleMoved() if self._begun_s is None:
                self._begun_s = event.time_s

    def accuracy(self, now_s: float) -> OwnAccuracy | None:
        """What counts now; None: in the first seconds the receiver may still be on its way."""
        receiver, begun_s = self._receiver, self._begun_s
        if receiver is None and (begun_s is None or now_s - begun_s <= HEARD_S):
            return None
        is_fresh = receiver is not None and now_s - receiver.time_s <= HEARD_S
        is_told = is_fresh and receiver is not None and receiver.horizontal_m is not None
        least_m = 0.0 if is_told else UNTOLD.horizontal_m
        horizontal_m = max(least_m, *self._horizontal_m.values(), 0.0)
        has_height = is_told and receiver is not None and receiver.vertical_m is not None
        least_m = 0.0 if has_height else HEIGHT_RATIO * horizontal_m
        return OwnAccuracy(horizontal_m, max(least_m, *self._vertical_m.values(), 0.0), is_told)
