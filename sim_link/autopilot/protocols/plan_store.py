"""The stored mission, fence and rally points, and which mission item comes next."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from sim_link.autopilot.protocols.plan_items import PlanItem, PlanType


@dataclass(frozen=True, slots=True)
class PlanChanged:
    """A plan was replaced, changed in part or cleared."""

    plan_type: PlanType


@dataclass(frozen=True, slots=True)
class CurrentChosen:
    """Somebody wants the mission to go on from another item."""

    seq: int


PlanEvent = PlanChanged | CurrentChosen


class PlanStore:
    """What a vehicle has been given to fly and to keep to.

    Args:
        home: Item 0 of a mission as ArduPilot shows it, whatever was uploaded there; None for
            an autopilot whose missions begin with item 0.
    """

    def __init__(self, home: Callable[[], PlanItem] | None = None) -> None:
        self._home = home
        self._plans: dict[PlanType, tuple[PlanItem, ...]] = dict.fromkeys(PlanType, ())
        self._current = 0
        self._events: list[PlanEvent] = []

    def items(self, plan_type: PlanType) -> tuple[PlanItem, ...]:
        """The items of a plan, in order."""
        return self._plans[plan_type]

    def is_home(self, plan_type: PlanType, seq: int) -> bool:
        """Whether an item is the vehicle's home and not the client's to choose."""
        return self._home is not None and plan_type is PlanType.MISSION and seq == 0

    def home_item(self) -> PlanItem | None:
        """Item 0 as it is now, where it is home."""
        return None if self._home is None else self._home()

    @property
    def current(self) -> int:
        """The mission item that is flown to, or would be first."""
        return self._current

    def advance(self, seq: int) -> None:
        """The vehicle itself went on to another item."""
        self._current = seq

    def choose(self, seq: int) -> bool:
        """Go on from an item because somebody asked; False if there is no such item."""
        if not 0 <= seq < len(self._plans[PlanType.MISSION]):
            return False
        self._current = seq
        self._events.append(CurrentChosen(seq))
        return True

    def replace(self, plan_type: PlanType, items: Sequence[PlanItem], current: int = 0) -> None:
        """Replace a plan as a whole.

        Args:
            plan_type: Which.
            items: None for a plan that is cleared.
            current: Where a mission begins.
        """
        self._plans[plan_type] = tuple(items)
        if plan_type is PlanType.MISSION:
            self._current = current
        self._events.append(PlanChanged(plan_type))

    def patch(self, plan_type: PlanType, seq: int, item: PlanItem) -> None:
        """Put one item in its place, or at the end, as ArduPilot does during an upload."""
        items = self._plans[plan_type]
        self._plans[plan_type] = (*items[:seq], item, *items[seq + 1 :])

    def truncate(self, plan_type: PlanType, count: int) -> None:
        """Drop what is beyond `count` items, as ArduPilot does before an upload."""
        self.replace(plan_type, self._plans[plan_type][:count])

    def take_events(self) -> list[PlanEvent]:
        """What the vehicle must know, since the last call."""
        events, self._events = self._events, []
        return events
