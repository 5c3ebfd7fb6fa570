"""What must have come of a flight: each expectation has a name, and a verdict at the end."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import UNSET, UnsetType

from companion.domain import Params
from sim_link.world.environment import EmitterId

Source = Literal["companion", "autopilot"]
INVARIANTS = tuple(f"I{number}" for number in range(1, 13))
NEVER_JUDGED = {"I10", "I12"}
"""What no flight alone can show: see missions.md."""
NotNegative = Annotated[float, msgspec.Meta(ge=0.0)]


class Bound(Params, frozen=True):
    """Limits of a number that is never negative; one of them at least."""

    at_most: NotNegative | None = None
    at_least: NotNegative | None = None

    def __post_init__(self) -> None:
        """Refuse a bound that bounds nothing, and one that nothing can keep."""
        if self.at_most is None and self.at_least is None:
            raise ValueError("give at_most, at_least or both")
        if self.at_most is not None and self.at_least is not None and self.at_least > self.at_most:
            raise ValueError("nothing is at least at_least and at most at_most: they are swapped")

    def holds(self, value: float) -> bool:
        """Whether a value is inside."""
        is_low = self.at_most is None or value <= self.at_most
        return is_low and (self.at_least is None or value >= self.at_least)

    def __str__(self) -> str:
        """In words."""
        low = "" if self.at_least is None else f"at least {self.at_least:g}"
        high = "" if self.at_most is None else f"at most {self.at_most:g}"
        return " and ".join(part for part in (low, high) if part)


class EmitterBound(Bound, frozen=True):
    """A bound on what concerns one emitter."""

    emitter: EmitterId | None = None
    """Its id; null: the scenario's `emitter`."""


class TextSeen(Params, frozen=True):
    """A text for the operator, or a message by its MAVLink name."""

    text: str | None = None
    """Part of a STATUSTEXT."""
    message: str | None = None
    """For example RADIO_RANGING."""
    from_: Source | None = msgspec.field(default=None, name="from")
    """Who sent it; null: anybody."""

    def __post_init__(self) -> None:
        """Refuse none and both."""
        if (self.text is None) == (self.message is None):
            raise ValueError("give either text or message")
        if not (self.text or self.message):
            raise ValueError("an empty text is part of every text")


class Appears(TextSeen, frozen=True):
    """It must have been sent."""

    at_least: Annotated[int, msgspec.Meta(ge=1)] = 1
    """How often."""


class Violations(Params, frozen=True):
    """How often the invariants of the companion may have been violated."""

    at_most: Annotated[int, msgspec.Meta(ge=0)] = 0
    invariants: tuple[str, ...] = INVARIANTS
    """Those that count."""

    def __post_init__(self) -> None:
        """Refuse invariants that do not exist."""
        for name in self.invariants:
            if name not in INVARIANTS:
                raise ValueError(f"there is no invariant {name}: I1 to I12 are")
        if not set(self.invariants) - NEVER_JUDGED:
            raise ValueError("invariants: none that a flight can judge; leave the list out")


class Expectation(Params, frozen=True, kw_only=True):
    """One expectation: a name and exactly one of the other keys."""

    name: Annotated[str, msgspec.Meta(min_length=1, max_length=100)]
    final_error_m: EmitterBound | UnsetType = UNSET
    """Distance of the last estimate from the true emitter."""
    error_over_r95: EmitterBound | UnsetType = UNSET
    """The same in R95: at most 1 in 95 of 100 flights if R95 is honest."""
    reported_s: EmitterBound | UnsetType = UNSET
    """When the target was reported, since control was first given."""
    time_s: Bound | UnsetType = UNSET
    """Of the whole mission."""
    distance_m: Bound | UnsetType = UNSET
    """Flown in the whole mission."""
    violations: Violations | UnsetType = UNSET
    """Of the invariants I1 to I12."""
    appears: Appears | UnsetType = UNSET
    never: TextSeen | UnsetType = UNSET
    """It must not have been sent."""
    holds: str | UnsetType = UNSET
    """A condition that holds at the end."""
    always: str | UnsetType = UNSET
    """A condition that is never false, from the first step to the last."""

    def __post_init__(self) -> None:
        """Refuse none and several."""
        names = [n for n in self.__struct_fields__ if n != "name"]
        given = [name for name in names if getattr(self, name) is not UNSET]
        if len(given) != 1:
            found = " and ".join(given) if given else "none"
            raise ValueError(f"an expectation is exactly one of its kinds, not {found}")

    @property
    def kind(self) -> str:
        """Which of its kinds it is."""
        names = (n for n in self.__struct_fields__ if n != "name")
        return next(name for name in names if getattr(self, name) is not UNSET)
