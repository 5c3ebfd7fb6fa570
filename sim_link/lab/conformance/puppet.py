"""Scripted vehicle for a companion under test: it reports whatever a rule requires.

It has no physics: it hovers where it is sent, and its HEARTBEAT shows the mode that the rule set,
as an operator would have chosen it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from companion.mav.dialect import Message, mavlink
from sim_link.lab.conformance import mavlink_oracle as mav
from sim_link.lab.conformance.mavlink_oracle import ZERO, FrameSpec
from sim_link.lab.conformance.rules import Flavour, Role, Violation, assume, require
from sim_link.lab.conformance.station import MAVLINK_VERSION, ProbeLink, Station, brief, source_of

VEHICLE = (1, 1)
ORIGIN_E7_MM = (473_977_420, 85_455_940, 488_000)
"""Latitude and longitude, 1e-7 degrees, and altitude, mm: origin and home."""
HOVER_DOWN_M = -10.0
FIRST_WORD_S = 90.0
"""Longest wait for a companion's first message, s: compiling its kernels takes half a minute."""
SETTLE_S = 5.0
"""Time until the companion knows the vehicle; it may listen 3 s for two systems."""
UNKNOWN_COMMAND = 31_999
SENSORS = 1 | 2 | 4 | 8 | 32 | 0x200000 | 0x2000000 | mav.PREARM

SetpointMessage = mav.LocalTarget | mav.GlobalTarget
SETPOINTS = (mav.LocalTarget, mav.GlobalTarget)
CommandMessage = mav.CommandLong | mav.CommandInt


def position_of(message: SetpointMessage) -> tuple[float, ...]:
    """Return the position of a setpoint."""
    if isinstance(message, mav.LocalTarget):
        return (message.x, message.y, message.z)
    return (message.lat_int, message.lon_int, message.alt)


COMMANDS = (mav.CommandLong, mav.CommandInt)
Policy = Callable[[CommandMessage], int | None]
"""The MAV_RESULT of a command; None answers nothing."""


def accept(_: CommandMessage) -> int | None:
    """Accept every command."""
    return int(mavlink.MAV_RESULT_ACCEPTED)


def stay_silent(_: CommandMessage) -> int | None:
    """Answer nothing."""
    return None


class CompanionProbe(Station):
    """Scripted vehicle of a companion: it hovers, armed, or stands on the ground."""

    role = Role.COMPANION

    def __init__(
        self,
        link: ProbeLink,
        flavour: Flavour = Flavour.PX4,
        policy: Policy = accept,
        system_id: int = VEHICLE[0],
        *,
        is_flying: bool = True,
    ) -> None:
        super().__init__(link, system_id, VEHICLE[1], None)
        self.flavour = flavour
        self.mode = "hold"
        self.is_armed = is_flying
        self.is_failsafe = False
        self.policy = policy
        self.started_s = self.now_s - 100.0
        self.down_m = HOVER_DOWN_M if is_flying else 0.0
        self.on_message = self._answer
        self._stops: list[Callable[[], None]] = []
        self.come_back()

    def come_back(self) -> None:
        """Start sending, or start again."""
        self.go_silent()
        upright = [1.0, 0.0, 0.0, 0.0]
        status = mav.SysStatus(SENSORS, SENSORS, SENSORS, 100, 16_000, 500, 90, 0, 0, 0, 0, 0, 0)
        stream: tuple[tuple[float, Callable[[], Message]], ...] = (
            (1.0, self._heartbeat),
            (0.05, lambda: mav.LocalPosition(self._boot_ms, 10.0, 10.0, self.down_m, *ZERO)),
            (0.1, lambda: mav.Attitude(self._boot_ms, 0.0, 0.0, 0.3, *ZERO)),
            (0.5, self._global_position),
            (0.5, self._landed_state),
            (1.0, lambda: status),
            (
                1.0,
                lambda: mav.HomePosition(
                    *ORIGIN_E7_MM, *ZERO, upright, *ZERO, 1_000 * self._boot_ms
                ),
            ),
            (1.0, lambda: mav.Origin(*ORIGIN_E7_MM, 1_000 * self._boot_ms)),
        )
        for period_s, build in stream:
            self._stops.append(self.repeat(build, period_s))

    def go_silent(self) -> None:
        """Stop sending the vehicle's messages."""
        while self._stops:
            self._stops.pop()()

    def choose(self, mode: str) -> None:
        """Set the operator's mode; HEARTBEAT shows it at once."""
        self.mode = mode
        self.send(self._heartbeat())

    def send_as(self, message: Message, system_id: int, component_id: int) -> None:
        """Send a message with other ids."""
        self.send(message, FrameSpec(system_id, component_id))

    @property
    def companion(self) -> tuple[int, int]:
        """System and component of the companion that answers; `NotApplicable`: none does."""
        none = mavlink.MAV_AUTOPILOT_INVALID
        sources = [
            entry.source
            for entry in self.inbox
            if isinstance(entry.message, mav.Heartbeat) and entry.message.autopilot == none
        ]
        assume(bool(sources), "no companion heard")
        return sources[-1]

    def attach(self) -> None:
        """Wait for the companion, if there is one, and until it knows the vehicle."""
        is_heard = self.run_until(lambda: bool(self.heard(mav.Heartbeat)), FIRST_WORD_S)
        assume(is_heard, f"no companion heard within {FIRST_WORD_S:g} s")
        self.run(SETTLE_S)

    def setpoints(self, mark: int = 0) -> list[SetpointMessage]:
        """Return the setpoints received since a mark."""
        return [e.message for e in self.inbox[mark:] if isinstance(e.message, SETPOINTS)]

    def commands(self, mark: int = 0) -> list[CommandMessage]:
        """Return the commands received since a mark."""
        return [e.message for e in self.inbox[mark:] if isinstance(e.message, COMMANDS)]

    def require_addressed(self, messages: Sequence[CommandMessage | SetpointMessage]) -> None:
        """Require that all have the vehicle as their target."""
        for message in messages:
            target = (message.target_system, message.target_component)
            require(target == (self.system_id, self.component_id), brief(message))

    def await_setpoints(self, within_s: float = 15.0) -> None:
        """Wait until setpoints arrive; `NotApplicable`: the companion streams none unprompted."""
        mark = self.mark
        are_heard = self.run_until(lambda: bool(self.setpoints(mark)), within_s)
        assume(are_heard, f"no setpoints within {within_s:g} s")

    def give_control(self) -> None:
        """Hand over to the companion; `NotApplicable` if it streams nothing.

        PX4 requires the stream to run before; ArduPilot does not, so a companion may begin with it.
        """
        if self.flavour is Flavour.PX4:
            self.await_setpoints()
            self.run(1.5)
        self.choose("offboard")
        self.await_setpoints()
        self.run(2.0)

    def ask_companion(self, target: tuple[int, int]) -> int | None:
        """Send an unknown command, as for a ground station; return its result, or None."""
        mark = self.mark
        self.send_as(mav.CommandLong(*target, UNKNOWN_COMMAND, 0, *[0.0] * 7), 255, 190)
        self.run(1.0)
        acks = [m for m in self.heard(mav.Ack, mark) if m.command == UNKNOWN_COMMAND]
        if len(acks) > 1:
            raise Violation(f"{len(acks)} acknowledgements")
        return int(acks[0].result) if acks else None

    def _answer(self, message: Message) -> None:
        if not isinstance(message, (*COMMANDS, mav.PlanRequest)):
            return
        target = (message.target_system, message.target_component)
        if target not in ((self.system_id, self.component_id), (self.system_id, 0)):
            return
        asker = source_of(message)
        if isinstance(message, mav.PlanRequest):  # neither a mission nor a fence nor rally points
            self.send(mav.Count(*asker, 0, message.mission_type))
            return
        result = self.policy(message)
        if result is not None:
            self.send(mav.Ack(message.command, result, 255, 0, *asker))

    @property
    def _boot_ms(self) -> int:
        return round(1e3 * (self.now_s - self.started_s))

    def _heartbeat(self) -> Message:
        state = mav.ACTIVE if self.is_armed else mavlink.MAV_STATE_STANDBY
        if self.is_failsafe:
            state = mav.CRITICAL
        return mav.Heartbeat(
            mavlink.MAV_TYPE_QUADROTOR,
            mav.AUTOPILOT_OF[self.flavour],
            mav.CUSTOM | (mav.ARMED if self.is_armed else 0),
            mav.custom_mode(self.flavour, self.mode),
            state,
            MAVLINK_VERSION,
        )

    def _global_position(self) -> Message:
        latitude, longitude, altitude = ORIGIN_E7_MM
        above = round(-1e3 * self.down_m)
        return mav.GlobalPosition(
            self._boot_ms, latitude + 898, longitude + 1_326, altitude + above, above, 0, 0, 0, 1719
        )

    def _landed_state(self) -> Message:
        flying, ground = mavlink.MAV_LANDED_STATE_IN_AIR, mavlink.MAV_LANDED_STATE_ON_GROUND
        return mav.SysState(0, flying if self.down_m < -0.5 else ground)
