"""The base of all invariants: what each may look at, and how it reports."""

from __future__ import annotations

from collections.abc import Mapping

from companion.domain import FlightMode
from sim_link.lockstep.observer import Frame
from sim_link.monitor.scene import Scene, Setpoint


class Invariant:
    """One invariant of one flight; a subclass overrides what it looks at.

    Args:
        scene: What all invariants share.
    """

    name = "I0"
    title = ""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    def report(self, what: str, **numbers: float) -> None:
        """It does not hold now."""
        self.scene.report(self.name, what, numbers)

    def setpoint(self, setpoint: Setpoint) -> None:
        """The companion sent a setpoint."""

    def sent(self, frame: Frame) -> None:
        """The companion sent a frame, setpoints among them."""

    def heard(self, frame: Frame) -> None:
        """A frame reached the companion; the scene knows of it."""

    def stepped(self) -> None:
        """The vehicle moved."""

    def ticked(self) -> None:
        """The companion's control tick is over."""

    def noted(self, kind: str, fields: Mapping[str, object]) -> None:
        """The companion wrote something into its journal."""

    def started(self) -> None:
        """The companion process began."""

    def mode_chosen(self, mode: FlightMode) -> None:
        """A person switched the mode."""

    def rebooted(self) -> None:
        """The vehicle began anew."""
