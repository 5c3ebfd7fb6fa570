"""What a monitor reports."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Violation:
    """An invariant that did not hold."""

    time_s: float
    invariant: str
    """I1 to I12."""
    what: str
    """One phrase, the same for the same kind of violation."""
    numbers: Mapping[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        numbers = ", ".join(f"{name} {value:.4g}" for name, value in self.numbers.items())
        return f"{self.time_s:.3f} s {self.invariant}: {self.what}" + (
            f" ({numbers})" if numbers else ""
        )
