"""Companions with a bug each, which must be found: the test of the monitor and of the faults.

Every class is the genuine companion with one thing spoilt at its edge.
"""

from __future__ import annotations

import math
import secrets
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from companion.config.schema import CompanionConfig
from companion.config.tunables import Tunables
from companion.domain import Autopilot, FlightMode, TargetEstimate
from companion.flight_setup import build_planner, build_session
from companion.guard.gate import GuardReason
from companion.guidance.control_authority import Reason
from companion.guidance.events import AutopilotFenceRead
from companion.link import outbound
from companion.link.endpoint import CompanionEndpoint
from companion.link.interface import EndpointParams, Journal, LinkSpec
from companion.mav.codec import MavCodec, message_id
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Chunk
from companion.mav.flight_modes import set_mode_params
from sim_link.lab.faults.fault_effects import rewrite_frame
from sim_link.lab.lockstep import MakeCompanion

SETPOINT = mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED
HEARTBEAT = mavlink.MAVLINK_MSG_ID_HEARTBEAT
FAR_M = 500.0
SPOILT_EVERY = 40
INSIDE_WEST_M = 54.0


class Planted(CompanionEndpoint):
    """The genuine companion, whose output passes `_spoil`."""

    invariant = ""
    """The one that must be reported."""

    def __init__(
        self, config: CompanionConfig, journal: Journal, links: Sequence[LinkSpec]
    ) -> None:
        super().__init__(
            build_session(config),
            EndpointParams(config.vehicle, config.link, tuple(links)),
            journal,
            tunables=Tunables(config, build_planner),
        )
        self._codec = MavCodec(1, mavlink.MAV_COMP_ID_ONBOARD_COMPUTER)
        self._now_s = 0.0
        self._count = 0
        self._last: bytes | None = None

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Take in what arrived."""
        self._now_s = now_s
        super().receive(chunk, now_s)

    def handle_timer(self, now_s: float) -> None:
        """The control tick."""
        self._now_s = now_s
        super().handle_timer(now_s)

    def take_output(self) -> list[Chunk]:
        """Return the genuine companion's output, spoilt."""
        return [
            chunk._replace(data=data)
            for chunk in super().take_output()
            for data in self._frames(chunk.data)
        ]

    def _frames(self, frame: bytes) -> list[bytes]:
        if message_id(frame) != SETPOINT:
            return self._spoil_other(frame)
        self._count += 1
        frames = self._spoil(frame)
        self._last = frames[-1] if frames else self._last
        return frames

    def _spoil(self, frame: bytes) -> list[bytes]:
        """Return the frames sent in place of a setpoint."""
        return [frame]

    def _spoil_other(self, frame: bytes) -> list[bytes]:
        """Return the frames sent in place of any other frame."""
        return [frame]

    @property
    def _is_flying(self) -> bool:
        return self.session.vehicle.is_ours

    def _encoded(self, message: Message) -> bytes:
        return self._codec.encode(message)


class FliesAway(Planted):
    """Its setpoints lie half a kilometre off."""

    invariant = "I1"

    def _spoil(self, frame: bytes) -> list[bytes]:
        return [rewrite_frame(frame, self._change, None)] if self._is_flying else [frame]

    def _change(self, message: Any) -> None:
        message.x += FAR_M


class Jumps(Planted):
    """Now and then a setpoint lies a few metres aside."""

    invariant = "I2"

    def _spoil(self, frame: bytes) -> list[bytes]:
        if not self._is_flying or self._count % SPOILT_EVERY:
            return [frame]
        return [rewrite_frame(frame, self._change, None)]

    def _change(self, message: Any) -> None:
        message.x += 6.0


class ChasesJumps(Planted):
    """It flies inside at once by a position that jumped, as if that were right."""

    invariant = "I1"

    def _spoil(self, frame: bytes) -> list[bytes]:
        finding = self.session.context.finding
        is_held = finding is not None and finding.reason is Reason.OWN_JUMP
        return (
            [rewrite_frame(frame, self._change, None)] if is_held and self._is_flying else [frame]
        )

    def _change(self, message: Any) -> None:
        message.x = message.y = 0.0


class RushesIn(Planted):
    """From outside it wants to be inside at once, however far that is."""

    invariant = "I2"

    def _spoil(self, frame: bytes) -> list[bytes]:
        reasons = self.session.context.steering.reasons
        is_outside = GuardReason.OUTSIDE in reasons and self._is_flying
        return [rewrite_frame(frame, self._change, None)] if is_outside else [frame]

    def _change(self, message: Any) -> None:
        message.y = -INSIDE_WEST_M


class KeepsFlying(Planted):
    """After the pilot took over it goes on sending."""

    invariant = "I3"

    def take_output(self) -> list[Chunk]:
        """Return the output with the last setpoint after every heartbeat, in any mode."""
        chunks = super().take_output()
        if self._last is None or self._is_flying:
            return chunks
        again = [c._replace(data=self._last) for c in chunks if message_id(c.data) == HEARTBEAT]
        return chunks + again


class AsksAgain(Planted):
    """After the pilot took over it asks for the mode again."""

    invariant = "I3"

    def _spoil_other(self, frame: bytes) -> list[bytes]:
        if message_id(frame) != HEARTBEAT or self._last is None or self._is_flying:
            return [frame]
        autopilot = self.session.vehicle.autopilot
        if autopilot is Autopilot.OTHER:
            return [frame]
        params = set_mode_params(FlightMode.OFFBOARD, autopilot, is_armed=True)
        ask = mavlink.MAVLink_command_long_message(
            1, 1, mavlink.MAV_CMD_DO_SET_MODE, 0, *params, *[0.0] * 4
        )
        return [frame, self._encoded(ask)]


class SendsToEverybody(Planted):
    """Its setpoints go to every address that is heard."""

    invariant = "I3"

    def take_output(self) -> list[Chunk]:
        """Setpoints without an address."""
        return [
            chunk._replace(peer=None) if message_id(chunk.data) == SETPOINT else chunk
            for chunk in super().take_output()
        ]


class SendsVelocity(Planted):
    """Its setpoints are velocities, which go on for ever if nothing follows."""

    invariant = "I4"

    def _spoil(self, frame: bytes) -> list[bytes]:
        return [rewrite_frame(frame, self._change, None)]

    def _change(self, message: Any) -> None:
        message.type_mask = 0x0DC7
        message.vx = 5.0


class Extrapolates(Planted):
    """It flies on while it does not know where it is."""

    invariant = "I5"

    def __init__(
        self, config: CompanionConfig, journal: Journal, links: Sequence[LinkSpec]
    ) -> None:
        super().__init__(config, journal, links)
        self._blind = 0

    def _spoil(self, frame: bytes) -> list[bytes]:
        is_blind = not self.session.vehicle.is_position_fresh(self._now_s)
        self._blind = self._blind + 1 if is_blind and self._is_flying else 0
        return [rewrite_frame(frame, self._change, None)] if self._blind else [frame]

    def _change(self, message: Any) -> None:
        message.x += 0.05 * self._blind


class SendsNan(Planted):
    """Now and then a coordinate is not a number."""

    invariant = "I6"

    def _spoil(self, frame: bytes) -> list[bytes]:
        return [frame] if self._count % SPOILT_EVERY else [rewrite_frame(frame, self._change, None)]

    def _change(self, message: Any) -> None:
        message.yaw_rate = math.nan


class SendsParameters(Planted):
    """It sets a parameter of the autopilot."""

    invariant = "I6"

    def _spoil_other(self, frame: bytes) -> list[bytes]:
        if message_id(frame) != HEARTBEAT:
            return [frame]
        message = mavlink.MAVLink_param_set_message(1, 1, b"COM_OF_LOSS_T", 60.0, 9)
        return [frame, self._encoded(message)]


class Pauses(Planted):
    """Some setpoints in a row do not leave."""

    invariant = "I7"

    def _spoil(self, frame: bytes) -> list[bytes]:
        return [] if self._count % 100 < 4 else [frame]


class SendsInBackground(Planted):
    """Its control tick dies, and something else keeps its heartbeat and setpoints alive."""

    invariant = "I8"
    DIES_S = 20.0

    def next_timer_s(self) -> float:
        """Never again, after a while."""
        return math.inf if self._now_s > self.DIES_S else super().next_timer_s()

    def take_output(self) -> list[Chunk]:
        """Return the last setpoint again, although no control tick decided it."""
        chunks = super().take_output()
        if self._now_s > self.DIES_S + 1.0 and self._last is not None:
            chunks.append(Chunk(0, self._last, self.binding.peer))
            self._now_s = self.DIES_S + 0.5
        return chunks


class BelievesAnybody(Planted):
    """It takes every frame for the vehicle's, wherever it comes from."""

    invariant = "I10"

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Process a chunk as if it came from the bound peer."""
        super().receive(chunk._replace(peer=self.binding.peer or chunk.peer), now_s)


class FollowsTheNextPeer(Planted):
    """After a silence it follows the first address with the vehicle's ids, without a check."""

    invariant = "I10"

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Move to the address at once."""
        binding = self.binding
        is_silent = binding.heard_s is not None and now_s - binding.heard_s >= binding.silence_s
        if is_silent and chunk.peer != binding.peer:
            binding._move(chunk.peer, now_s)
        super().receive(chunk, now_s)


class Chatters(Planted):
    """It announces everything to the operator many times."""

    invariant = "I11"

    def _spoil(self, frame: bytes) -> list[bytes]:
        text = mavlink.MAVLink_statustext_message(6, b"still here")
        return [frame, *[self._encoded(text) for _ in range(20)]]


class RepeatsItself(Planted):
    """It announces the same with another figure every five seconds."""

    invariant = "I13"
    _said_s = 0.0

    def _spoil(self, frame: bytes) -> list[bytes]:
        if self._now_s - self._said_s < 5.0:
            return [frame]
        self._said_s = self._now_s
        words = f"hold: no ranging for {self._now_s:.1f} s, whatever the pilot does"
        return [frame, *map(self._encoded, outbound.status_text(4, words, self._count))]


class KeepsItsFence(Planted):
    """It reads the fence of another station in flight, and flies by the one it had."""

    invariant = "I1"

    def __init__(
        self, config: CompanionConfig, journal: Journal, links: Sequence[LinkSpec]
    ) -> None:
        super().__init__(config, journal, links)
        fencing = self.session.fencing
        take = fencing.take

        def take_on_the_ground(event: AutopilotFenceRead) -> None:
            if self._is_flying:
                fencing.is_doubted = fencing.is_urgent = False
            else:
                take(event)

        setattr(fencing, "take", take_on_the_ground)  # noqa: B010 - a method


class NeverReadsAgain(Planted):
    """It reads the autopilot's fence once."""

    invariant = "I1"

    def __init__(
        self, config: CompanionConfig, journal: Journal, links: Sequence[LinkSpec]
    ) -> None:
        super().__init__(config, journal, links)
        for name in ("notice", "_is_due_again"):
            setattr(self._queries.fence, name, lambda *_: False)


class HasMoods(Planted):
    """Its output depends on more than its input."""

    invariant = "I12"

    def _spoil(self, frame: bytes) -> list[bytes]:
        return [rewrite_frame(frame, self._change, None)]

    def _change(self, message: Any) -> None:
        message.yaw = secrets.randbelow(1000) * 1e-6


def twisted(estimate: TargetEstimate | None) -> TargetEstimate | None:
    """An estimate whose covariance is not positive: what I9 must find."""
    if estimate is None:
        return None
    (a, b), (c, d) = estimate.covariance_m2
    return replace(estimate, covariance_m2=((-a, b), (c, d)))


DEFECTS: tuple[type[Planted], ...] = (
    FliesAway,
    Jumps,
    KeepsFlying,
    AsksAgain,
    SendsVelocity,
    Extrapolates,
    SendsNan,
    SendsParameters,
    Pauses,
    SendsInBackground,
    BelievesAnybody,
    Chatters,
    RepeatsItself,
    HasMoods,
)


def maker(defect: type[Planted]) -> MakeCompanion:
    """Return the function by which a flight starts the companion with this bug."""
    return defect
