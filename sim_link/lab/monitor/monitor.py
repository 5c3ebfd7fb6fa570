"""Monitor: an observer of a flight that reports violated invariants.

Theory of operation. One `ObservedScene` keeps the reports to the companion and the truth; thirteen
small invariants (I1 to I13) look at it whenever a frame is sent or heard, a tick is over or the
vehicle moved. None uses the companion's own guard, estimator or guidance; its own reports (its
phase, its estimate) are only checked. A `Scope` selects the invariants by which a kind of flight is
judged.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from companion.domain import FlightMode
from companion.mav.dialect import mavlink
from companion.mav.signing import SigningKey
from sim_link.autopilot.vehicle import SimVehicle
from sim_link.lab.monitor import authority_invariants, fence_invariants, message_invariants
from sim_link.lab.monitor.independent_checks import SETPOINTS, Proof, SenderTrust
from sim_link.lab.monitor.scene import (
    AUTOPILOT_COMPONENT,
    Invariant,
    InvariantViolation,
    ObservedScene,
    ObservedState,
    Rules,
    TrueScene,
)
from sim_link.lab.observer import Frame, Observer, overriding
from sim_link.neighbours import Neighbour

VEHICLE_PEER = ("127.0.0.1", 14580)
"""Address of the vehicle in lockstep."""
NOTICE_S = 2.0
"""Time to detect two clocks: three changes between them, and a second in which both ran."""

TITLES = {
    kind.name: kind.title
    for kind in sorted(Invariant.__subclasses__(), key=lambda kind: int(kind.name[1:]))
}


@dataclass(frozen=True, slots=True)
class Scope:
    """Invariants that are judged, and those that are not."""

    judged: Mapping[str, str]
    """Restriction of the judgement, by the invariant's name; empty: none."""
    unjudged: Mapping[str, str]
    """Reason why it was not judged, by the invariant's name."""

    def unjudged_of(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the given invariants that are not judged."""
        return tuple(name for name in names if name not in self.judged)


NOTHING = Scope({}, dict.fromkeys(TITLES, "not watched"))
_TWICE = "needs a second flight with the same seed"
LOCKSTEP = Scope(
    judged={
        **dict.fromkeys(("I1", "I2", "I3", "I4", "I5", "I6", "I7", "I8", "I9"), ""),
        "I11": "frames and lines of the log, not queues",
        "I13": "",
    },
    unjudged={
        "I10": "needs the companion's whole state around every frame; fault campaigns compare it",
        "I12": _TWICE,
    },
)
"""A mission in memory: every frame, every step of the true vehicle and every control tick."""
WIRE = Scope(
    judged={
        "I1": "setpoints and the ways to them, not the true vehicle",
        "I2": "",
        "I3": "the mode may come back from a person or from the autopilot itself",
        "I4": "every setpoint is a position; where it leads is not flown on",
        "I5": "",
        "I6": "",
        "I7": "at the receiver, with the companion's log",
        "I9": "as the companion's log has it",
        "I11": "frames and lines of the log, not queues",
        "I13": "",
    },
    unjudged={
        "I8": "the control tick does not show outside of the process",
        "I10": "needs the companion's whole state around every frame",
        "I12": "real clocks never repeat",
    },
)
"""Real processes: the frames of both directions as they pass the hub, and the companion's log."""


class FrameMonitor(Observer):
    """Shows invariants a flight: frames, journal and process; with the key of a signed link."""

    def __init__(
        self, scene: ObservedScene, invariants: Sequence[Invariant], key: SigningKey | None = None
    ) -> None:
        self._shared = scene
        self.invariants = list(invariants)
        self._proof = None if key is None else Proof(key)
        scene.is_signed = key is not None
        self._whose = SenderTrust(scene.rules.system_id)
        self._hooks = {
            name: [getattr(each, name) for each in overriding(self.invariants, Invariant, name)]
            for name, hook in vars(Invariant).items()
            if callable(hook) and not name.startswith("_")
        }

    def _show(self, what: str, *values: object) -> None:
        """Pass an event to the invariants that handle it."""
        for hook in self._hooks[what]:
            hook(*values)

    @property
    def violations(self) -> list[InvariantViolation]:
        """Violations in the order of time; at most twenty of a kind."""
        return self._shared.violations

    def sent(self, frame: Frame) -> None:
        """Handle a frame that the companion sent."""
        self._shared.now_s = frame.time_s
        setpoint = self._shared.setpoint_of(frame)
        self._show("sent", frame)
        if setpoint is not None:
            self._show("setpoint", setpoint)

    def heard(self, frame: Frame) -> None:
        """Handle a frame that reaches the companion."""
        scene = self._shared
        scene.now_s = frame.time_s
        if self._proof is not None and not frame.is_readable:
            self._proof.unreadable()
        is_here = frame.peer == VEHICLE_PEER and frame.is_readable and not scene.is_signed
        scene.is_indistinct = is_here and not frame.is_genuine and scene.is_of_autopilot(frame)
        is_judged = frame.is_readable and not scene.is_indistinct
        scene.has_silent_vehicle = self._whose.has_silent_vehicle(frame.time_s)
        scene.must_accept = is_judged and self._must_accept(frame)
        if is_judged and not scene.must_accept and not scene.is_signed:
            scene.is_indistinct = frame.is_genuine and self._whose.is_unclear
        scene.is_lied_to = not scene.is_signed and self._whose.follows_unknown_peer
        if scene.must_accept:
            scene.observe(frame)
            scene.note_fence(frame)
        self._show("heard", frame)

    def _must_accept(self, frame: Frame) -> bool:
        if self._proof is not None:
            return self._proof.accepts(frame.data)
        if frame.sender[1] == AUTOPILOT_COMPONENT:
            return self._whose.accepts(frame)
        return frame.is_genuine or self._whose.is_beside_unknown_peer(frame)

    def vehicle_sent(self, frame: Frame) -> None:
        """Handle a frame that the vehicle sent."""
        self._shared.remember(frame)

    def noted(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Handle a journal entry of the companion."""
        self._shared.now_s = now_s
        self._show("noted", kind, fields)

    def companion_started(self, now_s: float) -> None:
        """Handle a restart of the companion process."""
        scene = self._shared
        scene.now_s, scene.tick_s = now_s, None
        scene.is_companion_up = True
        scene.in_force.clear()
        self._whose.restart()
        scene.observed = ObservedState(origin_enu_m=scene.observed.origin_enu_m)
        self._show("started")

    def companion_suspended(self, now_s: float, until_s: float) -> None:  # noqa: ARG002
        """Handle a suspension of the companion process."""
        self._shared.suspended_until_s = max(self._shared.suspended_until_s, until_s)

    def companion_ended(self, now_s: float) -> None:  # noqa: ARG002
        """Handle the end of the companion process."""
        self._shared.is_companion_up = False

    def mode_chosen(self, mode: FlightMode, now_s: float) -> None:
        """Handle a mode switch by a person."""
        self._shared.now_s = now_s
        self._show("mode_chosen", mode)

    def vehicle_rebooted(self, now_s: float) -> None:
        """Handle a reboot of the vehicle, which voids its earlier reports."""
        scene = self._shared
        scene.now_s = now_s
        scene.observed.position_boot_ms = -1
        scene.observed.mode_sent_at = (-1.0, 0)


class Monitor(FrameMonitor):
    """Watches a flight with known truth; I10 needs snapshots of the companion's state.

    The key is that of a signed link; `dropped` is how many frames were dropped unread so far.
    """

    def __init__(
        self,
        rules: Rules,
        vehicle: SimVehicle,
        *,
        estimate: message_invariants.Estimate = lambda: None,
        snapshot: message_invariants.Snapshot | None = None,
        key: SigningKey | None = None,
        dropped: Callable[[], int] = lambda: 0,
    ) -> None:
        self.scene = scene = TrueScene(rules, vehicle=vehicle)
        self.fence = fence_invariants.InsideFence(scene)
        self.authority = authority_invariants.OnlyWithAuthority(scene)
        self.stream = authority_invariants.KeepsStreaming(scene)
        self.repeat = message_invariants.Repeatable(scene)
        self._dropped, self._dropped_before = dropped, 0
        self._proved: message_invariants.OnlyProvedFrames | None = None
        invariants: list[Invariant] = [
            self.fence,
            fence_invariants.FenceIsRead(scene),
            message_invariants.WithinEnvelope(scene),
            self.authority,
            fence_invariants.SafeToFreeze(scene, lambda: self.fence.is_moved_by_others),
            message_invariants.FreshState(scene),
            message_invariants.KnownFrames(scene),
            self.stream,
            authority_invariants.SilentWithoutTick(scene),
            message_invariants.HonestCovariance(scene, estimate),
            message_invariants.Bounded(scene),
            authority_invariants.FewTexts(scene),
            self.repeat,
        ]
        if snapshot is not None:
            self._proved = message_invariants.OnlyProvedFrames(scene, snapshot)
            invariants.append(self._proved)
        super().__init__(scene, invariants, key)

    def heard(self, frame: Frame) -> None:
        """Handle a frame that reaches the companion."""
        self._dropped_before = self._dropped()
        super().heard(frame)

    def read(self, frame: Frame) -> None:
        """Handle a frame that the companion has read or dropped."""
        if self._dropped() > self._dropped_before:
            (self._proof or self._whose).dropped()
        if self._proved is not None:
            self._proved.read(frame)

    def vehicle_heard(self, frame: Frame) -> None:
        """Handle a frame of the companion that reached the vehicle."""
        self.fence.reached(frame)

    def neighbour_heard(self, frame: Frame, neighbour: Neighbour) -> None:
        """Report a setpoint or a request that another vehicle would obey.

        Where one with our ids appears behind our own address, it takes a moment to be seen. With a
        key it is not seen at all, as all that it sends is refused: else any forged frame could end
        control.
        """
        message, setup = frame.message, neighbour.setup
        is_command = isinstance(message, mavlink.MAVLink_command_long_message)
        is_asking = is_command and getattr(message, "command", 0) in authority_invariants.RAISES
        is_obeyed = is_asking or frame.number in SETPOINTS
        if not is_obeyed or getattr(message, "target_system", 0) not in (0, setup.system_id):
            return
        is_alike = setup.system_id == self.scene.system_id and neighbour.peer == VEHICLE_PEER
        if is_alike and self.scene.is_signed:
            return
        if frame.time_s - neighbour.began_s > (NOTICE_S if is_alike else 0.0):
            self.scene.now_s = frame.time_s
            self.scene.report("I3", "a setpoint or a request to another vehicle")

    def stepped(self, vehicle: SimVehicle, now_s: float) -> None:
        """Handle a physics step of the vehicle."""
        self.scene.now_s = now_s
        self.scene.look_at(vehicle)
        if not self.scene.is_flying:
            self.scene.in_force.land()
        self._show("stepped")

    def ticked(self, now_s: float) -> None:
        """Handle the end of a control tick."""
        self.scene.now_s = self.scene.tick_s = self._whose.ticked_s = now_s
        self._show("ticked")
