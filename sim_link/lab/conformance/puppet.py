"""A vehicle on strings, shown to a companion: it says what a rule wants it to say.

It has no physics: it hovers where it is told, and its HEARTBEAT shows the mode that the rule set,
as an operator would have chosen it.
"""

from __future__ import annotations

from collections.abc import Callable

from companion.mav.dialect import Message, mavlink
from sim_link.lab.conformance import mavlink_oracle
from sim_link.lab.conformance.mavlink_oracle import FrameSpec
from sim_link.lab.conformance.rules import Flavour, NotApplicable, Violation
from sim_link.lab.conformance.station import MAVLINK_VERSION, ProbeLink, Station

VEHICLE = (1, 1)
PLACE = (473_977_420, 85_455_940, 488_000)
"""Latitude and longitude, 1e-7 degrees, and altitude, mm: origin and home."""
HOVER_DOWN_M = -10.0
FIRST_WORD_S = 90.0
"""A companion that compiles its kernels for the first time takes half a minute."""
SETTLE_S = 2.0
ARMED = mavlink.MAV_MODE_FLAG_SAFETY_ARMED
SENSORS = 1 | 2 | 4 | 8 | 32 | 0x200000 | 0x2000000 | mavlink.MAV_SYS_STATUS_PREARM_CHECK

LocalTarget = mavlink.MAVLink_set_position_target_local_ned_message
GlobalTarget = mavlink.MAVLink_set_position_target_global_int_message
SetpointMessage = LocalTarget | GlobalTarget
SETPOINTS = (LocalTarget, GlobalTarget)
CommandMessage = mavlink.MAVLink_command_long_message | mavlink.MAVLink_command_int_message
COMMANDS = (mavlink.MAVLink_command_long_message, mavlink.MAVLink_command_int_message)
Heartbeat = mavlink.MAVLink_heartbeat_message
Ack = mavlink.MAVLink_command_ack_message
PlanRequest = mavlink.MAVLink_mission_request_list_message
Policy = Callable[[CommandMessage], int | None]
"""The MAV_RESULT of a command; None answers nothing."""


def accept(command: CommandMessage) -> int | None:
    """Accept every command."""
    del command
    return int(mavlink.MAV_RESULT_ACCEPTED)


def stay_silent(command: CommandMessage) -> int | None:
    """Answer nothing."""
    del command
    return None


class CompanionProbe(Station):
    """Plays the vehicle that a companion serves.

    Args:
        is_flying: Whether it hovers, armed; otherwise it stands on the ground, disarmed.
    """

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

    # What the companion sees

    def come_back(self) -> None:
        """Begin, or begin again, to send."""
        self.go_silent()
        for build, period_s in (
            (self._heartbeat, 1.0),
            (self._local_position, 0.05),
            (self._attitude, 0.1),
            (self._global_position, 0.5),
            (self._landed_state, 0.5),
            (self._sys_status, 1.0),
            (self._home, 1.0),
            (self._origin, 1.0),
        ):
            self._stops.append(self.repeat(build, period_s))

    def go_silent(self) -> None:
        """Send nothing of the vehicle any more."""
        while self._stops:
            self._stops.pop()()

    def choose(self, mode: str) -> None:
        """The operator chooses a mode; HEARTBEAT tells it at once."""
        self.mode = mode
        self.send(self._heartbeat())

    def send_as(self, message: Message, system_id: int, component_id: int) -> None:
        """Send a message as someone else."""
        self.send(message, FrameSpec(system_id, component_id))

    # The companion

    @property
    def companion(self) -> tuple[int, int]:
        """System and component of whoever answers as a companion.

        Raises:
            NotApplicable: Nobody does.
        """
        none = mavlink.MAV_AUTOPILOT_INVALID
        beats = [m for m in self.heard(Heartbeat) if m.autopilot == none]
        if not beats:
            raise NotApplicable("no companion heard")
        return (beats[-1].get_srcSystem(), beats[-1].get_srcComponent())

    def attach(self) -> None:
        """Wait for the companion's first heartbeat, and until it knows the vehicle.

        Raises:
            NotApplicable: No companion is heard.
        """
        if not self.run_until(lambda: bool(self.heard(Heartbeat)), FIRST_WORD_S):
            raise NotApplicable(f"no companion heard within {FIRST_WORD_S:g} s")
        self.run(SETTLE_S)

    def come_to_rest(self, base_e7: tuple[int, int] | None = None) -> tuple[int, int] | None:
        """Leave the companion in peace: another mode, disarmed; a puppet has no base."""
        self.choose("hold")
        self.is_armed = False
        self.run(1.0)
        return base_e7

    def setpoints(self, mark: int = 0) -> list[tuple[float, SetpointMessage]]:
        """The setpoints that came since a mark, with their times."""
        return [
            (entry.time_s, entry.message)
            for entry in self.inbox[mark:]
            if isinstance(entry.message, SETPOINTS)
        ]

    def commands(self, mark: int = 0) -> list[tuple[float, CommandMessage]]:
        """The commands that came since a mark, with their times."""
        return [
            (entry.time_s, entry.message)
            for entry in self.inbox[mark:]
            if isinstance(entry.message, COMMANDS)
        ]

    def await_setpoints(self, within_s: float = 15.0) -> None:
        """Wait until setpoints come.

        Raises:
            NotApplicable: None come: the companion streams none unasked.
        """
        mark = self.mark
        if not self.run_until(lambda: bool(self.setpoints(mark)), within_s):
            raise NotApplicable(f"no setpoints within {within_s:g} s")

    def give_control(self) -> None:
        """The operator gives the vehicle to the companion.

        PX4 wants the stream to run before; ArduPilot does not, so a companion may begin with it.

        Raises:
            NotApplicable: It streams nothing.
        """
        if self.flavour is Flavour.PX4:
            self.await_setpoints()
            self.run(1.5)
        self.choose("offboard")
        self.await_setpoints()
        self.run(2.0)

    def ask_companion(self, number: int, *params: float, target: tuple[int, int]) -> int | None:
        """A ground station's COMMAND_LONG, forwarded by the vehicle; the result, or None."""
        padded = [*params, *[0.0] * (7 - len(params))]
        mark = self.mark
        self.send_as(mavlink.MAVLink_command_long_message(*target, number, 0, *padded), 255, 190)
        self.run(1.0)
        acks = [m for m in self.heard(Ack, mark) if m.command == number]
        if len(acks) > 1:
            raise Violation(f"{len(acks)} acknowledgements")
        return int(acks[0].result) if acks else None

    # Messages

    def _answer(self, message: Message) -> None:
        if not isinstance(message, (*COMMANDS, PlanRequest)):
            return
        target = (message.target_system, message.target_component)
        if target not in ((self.system_id, self.component_id), (self.system_id, 0)):
            return
        if isinstance(message, PlanRequest):
            self.send(_no_plan(message))
            return
        result = self.policy(message)
        if result is None:
            return
        asker = (message.get_srcSystem(), message.get_srcComponent())
        self.send(Ack(message.command, result, 255, 0, *asker))

    @property
    def boot_ms(self) -> int:
        """The vehicle's clock."""
        return round(1e3 * (self.now_s - self.started_s))

    def _heartbeat(self) -> Message:
        state = mavlink.MAV_STATE_ACTIVE if self.is_armed else mavlink.MAV_STATE_STANDBY
        if self.is_failsafe:
            state = mavlink.MAV_STATE_CRITICAL
        return Heartbeat(
            mavlink.MAV_TYPE_QUADROTOR,
            mavlink_oracle.AUTOPILOT_OF[self.flavour],
            mavlink_oracle.CUSTOM | (ARMED if self.is_armed else 0),
            mavlink_oracle.custom_mode(self.flavour, self.mode),
            state,
            MAVLINK_VERSION,
        )

    def _local_position(self) -> Message:
        return mavlink.MAVLink_local_position_ned_message(
            self.boot_ms, 10.0, 10.0, self.down_m, 0.0, 0.0, 0.0
        )

    def _attitude(self) -> Message:
        return mavlink.MAVLink_attitude_message(self.boot_ms, 0.0, 0.0, 0.3, 0.0, 0.0, 0.0)

    def _global_position(self) -> Message:
        latitude, longitude, altitude = PLACE
        above = round(-1e3 * self.down_m)
        return mavlink.MAVLink_global_position_int_message(
            self.boot_ms, latitude + 898, longitude + 1_326, altitude + above, above, 0, 0, 0, 1719
        )

    def _landed_state(self) -> Message:
        flying = mavlink.MAV_LANDED_STATE_IN_AIR
        ground = mavlink.MAV_LANDED_STATE_ON_GROUND
        return mavlink.MAVLink_extended_sys_state_message(
            0, flying if self.down_m < -0.5 else ground
        )

    def _sys_status(self) -> Message:
        return mavlink.MAVLink_sys_status_message(
            SENSORS, SENSORS, SENSORS, 100, 16_000, 500, 90, 0, 0, 0, 0, 0, 0
        )

    def _home(self) -> Message:
        return mavlink.MAVLink_home_position_message(
            *PLACE, 0.0, 0.0, 0.0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, 1_000 * self.boot_ms
        )

    def _origin(self) -> Message:
        return mavlink.MAVLink_gps_global_origin_message(*PLACE, 1_000 * self.boot_ms)


def _no_plan(request: PlanRequest) -> Message:
    """It has neither a mission nor a fence nor rally points."""
    return mavlink.MAVLink_mission_count_message(
        request.get_srcSystem(), request.get_srcComponent(), 0, request.mission_type
    )
