"""I9, I10 and I12: an honest covariance, no state from unproved frames, the same bytes again."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable

from companion.domain import TargetEstimate
from sim_link.lockstep.observer import Frame
from sim_link.monitor.invariant import Invariant
from sim_link.monitor.scene import Scene

SYMMETRY = 1e-6
"""Relative difference of the two off-diagonal elements that rounding explains."""
NEGATIVE = 1e-9
"""Share of the larger eigenvalue by which rounding makes the smaller one negative."""

Estimate = Callable[[], TargetEstimate | None]
"""The companion's estimate of the target, as it shows it."""
Snapshot = Callable[[], object]
"""Something that compares equal as long as nothing changed that the companion acts by."""


class HonestCovariance(Invariant):
    """The covariance is symmetric, positive semidefinite and bounded, and R95 is a number."""

    name = "I9"
    title = "the covariance is symmetric, positive and bounded"

    def __init__(self, scene: Scene, estimate: Estimate) -> None:
        super().__init__(scene)
        self._estimate = estimate
        self._seen: TargetEstimate | None = None

    def ticked(self) -> None:
        """Judge a new estimate."""
        estimate = self._estimate()
        if estimate is None or estimate is self._seen:
            return
        self._seen = estimate
        (a, b), (c, d) = estimate.covariance_m2
        values = (a, b, c, d, estimate.r95_m, *estimate.position_enu_m)
        if not all(map(math.isfinite, values)):
            self.report("an estimate that is no number")
            return
        if abs(b - c) > SYMMETRY * max(abs(b), abs(c), 1e-12):
            self.report("a covariance that is not symmetric", upper=b, lower=c)
        middle, radius = 0.5 * (a + d), math.hypot(0.5 * (a - d), 0.5 * (b + c))
        if middle - radius < -NEGATIVE * (middle + radius) or middle + radius < 0.0:
            self.report("a covariance that is not positive", eigenvalue=middle - radius)
        most = self.scene.rules.position_sigma_most_m
        if middle + radius > most * most:
            self.report("a covariance without bounds", sigma_m=math.sqrt(middle + radius))
        if estimate.r95_m < 0.0:
            self.report("a negative radius", r95_m=estimate.r95_m)


class OnlyProvedFrames(Invariant):
    """What is damaged, of a stranger or, with a key, not proved, changes nothing.

    Args:
        scene: What all invariants share.
        snapshot: The companion's state.
    """

    name = "I10"
    title = "no unproved frame changes any state"

    def __init__(self, scene: Scene, snapshot: Snapshot) -> None:
        super().__init__(scene)
        self._snapshot = snapshot
        self._before: object = None
        self._is_unproved = False
        self.unproved = 0
        """Frames that had to change nothing."""

    def heard(self, frame: Frame) -> None:  # noqa: ARG002
        """Remember the state before a frame that must not change it."""
        self._is_unproved = not self.scene.is_believable
        if self._is_unproved:
            self.unproved += 1
            self._before = self._snapshot()

    def read(self, frame: Frame) -> None:
        """Compare afterwards."""
        if self._is_unproved and self._snapshot() != self._before:
            self.report("an unproved frame changed the state", number=float(frame.number))
        self._is_unproved = False


class Repeatable(Invariant):
    """The digest of all that was sent: the same seed must give the same."""

    name = "I12"
    title = "the same seed gives the same bytes"

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self._hash = hashlib.blake2b(digest_size=16)

    def sent(self, frame: Frame) -> None:
        """Take it in."""
        self._hash.update(frame.data)

    @property
    def digest(self) -> str:
        """Of everything so far."""
        return self._hash.hexdigest()

    def compare(self, other: str) -> None:
        """With the digest of another flight of the same seed."""
        if self.digest != other:
            self.report("two flights of the same seed differ")
