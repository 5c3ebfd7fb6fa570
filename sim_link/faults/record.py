"""What every fault record has, and the types of their fields."""

from __future__ import annotations

import math
from typing import Annotated

import msgspec

from companion.domain import NonNegative, Params, Positive

Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
Count = Annotated[int, msgspec.Meta(ge=1, le=1000)]
Length = Annotated[float, msgspec.Meta(ge=-1e5, le=1e5)]
Rate = Annotated[float, msgspec.Meta(gt=0.0, le=100_000.0)]


class FaultRecord(Params, frozen=True, tag_field="kind"):
    """What every fault has."""

    start_s: NonNegative = 0.0
    duration_s: Positive = math.inf

    @property
    def end_s(self) -> float:
        """When it is over."""
        return self.start_s + self.duration_s

    def is_active(self, time_s: float) -> bool:
        """Whether it acts at a time since the schedule began."""
        return self.start_s <= time_s < self.end_s
