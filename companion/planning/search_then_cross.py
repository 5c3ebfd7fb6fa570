"""Search, then cross: a search pattern until there is contact, and again once it is lost.

Contact is a usable measurement that is not older than `lost_after_s`, with an estimate that does
not contradict its measurements. It hands over to the crossing planner at once; without it the
search goes on at the place where it was left, because what was heard there may be heard again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from companion.domain import EstimateState
from companion.planning.base import Plan, Planner, PlanRequest
from companion.planning.search import SearchMemory, SearchPlanner

Crossing = TypeVar("Crossing")


@dataclass(frozen=True, slots=True)
class SearchThenCrossMemory(Generic[Crossing]):
    """What both planners remember, and which of them flies."""

    search: SearchMemory | None
    crossing: Crossing
    is_crossing: bool = False


class SearchThenCross(Generic[Crossing]):
    """Two planners and the rule that hands over between them.

    Args:
        search: Flies while there is no contact.
        crossing: Flies while there is.
        lost_after_s: Without a usable measurement for this long, contact is lost.
    """

    def __init__(
        self, search: SearchPlanner, crossing: Planner[Crossing], lost_after_s: float
    ) -> None:
        self.search_after_s: float | None = lost_after_s
        self._lost_after_s = lost_after_s
        self._search = search
        self._crossing = crossing

    def initial_memory(self) -> SearchThenCrossMemory[Crossing]:
        """Neither has begun."""
        return SearchThenCrossMemory(self._search.initial_memory(), self._crossing.initial_memory())

    def plan(
        self, request: PlanRequest, memory: SearchThenCrossMemory[Crossing]
    ) -> Plan[SearchThenCrossMemory[Crossing]]:
        """The waypoint of the planner whose turn it is."""
        if self._has_contact(request, memory):
            crossed = self._crossing.plan(request, memory.crossing)
            return Plan(
                crossed.waypoint, SearchThenCrossMemory(memory.search, crossed.memory, True)
            )
        search = self._search.interrupted(memory.search) if memory.is_crossing else memory.search
        searched = self._search.plan(request, search)
        return Plan(
            searched.waypoint,
            SearchThenCrossMemory(searched.memory, self._crossing.initial_memory(), False),
        )

    def _has_contact(self, request: PlanRequest, memory: SearchThenCrossMemory[Crossing]) -> bool:
        if request.estimate is None:
            return False
        contact_s = request.contact_s
        if contact_s is not None and request.time_s - contact_s > self._lost_after_s:
            return False
        return memory.is_crossing or request.estimate.state is not EstimateState.DIVERGED
