"""Base of the invariants: rules, the observed scene, violations and the base class.

Theory of operation. The companion is judged by what it could know: the frames that reached it and
that it had to accept. A report of the mode is dated by when the vehicle sent it, because frames
overtake each other: an old one that arrives late takes nothing away and gives nothing back.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field

from companion.domain import FlightMode, NonNegative, Params, PositionEnu, Positive
from companion.geometry.coordinates import LocalOrigin
from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.protocols.message_streams import message_ids
from sim_link.autopilot.vehicle import SimVehicle
from sim_link.lab.monitor import independent_checks
from sim_link.lab.monitor.independent_checks import FencesInForce, FlownFence, Point
from sim_link.lab.observer import Frame

Corners = tuple[tuple[float, float], ...]

TICK_S = 0.05
"""Longest control period: an answer to a frame may be late by it."""


class Rules(Params, frozen=True):
    """Limits to keep; positions in the world's frame, east and north about the first origin."""

    fence_enu_m: Corners
    keeps_autopilot_fence: bool = True
    """False where the companion is configured to ignore the autopilot's own fence."""
    system_id: int | None = None
    """System id of the vehicle configured; None: the first one heard."""
    keep_out_enu_m: tuple[Corners, ...] = ()
    altitude_min_m: Positive = 5.0
    altitude_max_m: Positive = 60.0
    speed_mps: Positive = 5.0
    climb_mps: Positive = 2.0
    acceleration_mps2: Positive = 2.5
    step_m: Positive = 8.0
    latency_s: NonNegative = 0.5
    """Delay from a measurement of the vehicle's motion until it follows the setpoint."""
    navigation_sigma_m: NonNegative = 0.3
    state_age_s: Positive = 0.5
    """Longest age of a vehicle position that guidance may use."""
    answer_s: Positive = TICK_S
    """Time for which a setpoint may still leave after a frame that ends control."""
    gap_s: Positive = 0.1
    """Longest silence of the setpoints while in control."""
    silence_s: Positive = 10.0
    """Time without a HEARTBEAT after which control is unknown: the companion may fall silent."""
    stall_s: Positive = 0.5
    """Lateness of a control tick above which heartbeat and setpoints must have stopped."""
    sent_frames_per_s: Positive = 150.0
    sent_bytes_per_s: Positive = 15_000.0
    records_per_s: Positive = 60.0
    position_sigma_most_m: Positive = 2000.0

    @property
    def clearance_m(self) -> float:
        """Clearance of every setpoint from a border: three standard deviations, m."""
        return 3.0 * self.navigation_sigma_m


@dataclass(frozen=True, slots=True)
class InvariantViolation:
    """An invariant that did not hold."""

    time_s: float
    invariant: str
    what: str
    """One phrase, the same for the same kind of violation."""
    numbers: Mapping[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        numbers = ", ".join(f"{name} {value:.4g}" for name, value in self.numbers.items())
        return f"{self.time_s:.3f} s {self.invariant}: {self.what}" + (
            f" ({numbers})" if numbers else ""
        )


AUTOPILOT_COMPONENT = 1
OBSERVED_MESSAGES = frozenset(message_ids("HEARTBEAT LOCAL_POSITION_NED GPS_GLOBAL_ORIGIN"))
"""Messages that `ObservedState` keeps something of."""
REMEMBERED = 6000
"""Number of the vehicle's latest frames whose time of sending is kept."""
PX4_OFFBOARD_MAIN, ARDUPILOT_GUIDED = 6, 4
FRAME_STEP_M = 1.0
"""Step of an origin above which the local frame has moved as well."""
METRES_ROUNDING_M = 2e-3
"""Rounding of single precision some kilometres from the origin."""
DEGREES_ROUNDING_M = 9e-3
"""Rounding of degrees: half a step of 1e-7 is 5.6 mm, to the north and to the east, and the value
that it is compared with is rounded, too."""
MAX_PER_KIND = 20
"""Violations of one kind that are kept; more are counted."""


def is_offboard(heartbeat: mavlink.MAVLink_heartbeat_message) -> bool:
    """Return True if the mode obeys setpoints: PX4 main mode 6, ArduPilot mode 4."""
    if heartbeat.autopilot == mavlink.MAV_AUTOPILOT_PX4:
        return int(heartbeat.custom_mode) >> 16 & 0xFF == PX4_OFFBOARD_MAIN
    return int(heartbeat.custom_mode) == ARDUPILOT_GUIDED


@dataclass(slots=True)
class ObservedState:
    """Reports that reached the companion since its process began."""

    heartbeat_s: float | None = None
    is_ours: bool = False
    """True if the newest mode is ours and the vehicle is armed."""
    left_s: float = -math.inf
    """Time of the latest report of a mode that ended ours."""
    mode_sent_at: tuple[float, int] = (-1.0, 0)
    position_enu_m: PositionEnu | None = None
    """Position in the world's frame, by the reported origin."""
    velocity_enu_mps: PositionEnu = (0.0, 0.0, 0.0)
    position_s: float | None = None
    position_sent_s: float = -math.inf
    position_boot_ms: int = -1
    else_at: tuple[PositionEnu, float] | None = None
    """Vehicle position if its stamps went back without a restart, or if the last position was in a
    local frame whose origin was reported later; and its arrival time."""
    origin_sent_at: tuple[float, int] = (-1.0, 0)
    frame_sent_at: tuple[float, int] = (-1.0, 0)
    """Time of the report that the origin moved; earlier positions are in another frame."""
    origin_enu_m: PositionEnu = (0.0, 0.0, 0.0)
    """Zero of the local frame, as last reported."""


@dataclass(slots=True)
class SentSetpoint:
    """A setpoint that the companion sent."""

    time_s: float
    position_enu_m: PositionEnu
    message: Message

    @property
    def rounding_m(self) -> float:
        """Rounding of a horizontal position on the wire, m."""
        is_global = isinstance(self.message, mavlink.MAVLink_set_position_target_global_int_message)
        return DEGREES_ROUNDING_M if is_global else METRES_ROUNDING_M


@dataclass(slots=True)
class ObservedScene:
    """Shared by all invariants of one flight; subclasses know more or less of the vehicle.

    None stands for unknown; heights and positions are in the world's frame.
    """

    rules: Rules
    system_id: int | None = None
    is_px4: bool = True
    world_origin: LocalOrigin | None = None
    home_up_m: float | None = None
    height_error_m: float = 0.0
    is_flying: bool = False
    now_s: float = 0.0
    observed: ObservedState = field(default_factory=ObservedState)
    is_companion_up: bool = True
    tick_s: float | None = None
    """Time of the companion's last control tick."""
    suspended_until_s: float = -1.0
    """Time until which the companion process is suspended."""
    must_accept: bool = True
    """True if the last frame had to be accepted."""
    is_indistinct: bool = False
    """True if it was from another vehicle with our ids and address, and without a signature, or of
    ours after a stranger that was followed: the companion may accept it or not."""
    has_silent_vehicle: bool = False
    """True if the vehicle was silent for seconds before the last frame."""
    is_signed: bool = False
    """True if frames without a signature of our key are refused."""
    is_lied_to: bool = False
    """True if an unknown peer had to be accepted: in a flood of its positions any may count."""
    violations: list[InvariantViolation] = field(default_factory=list)
    counts: dict[tuple[str, str], int] = field(default_factory=dict)
    in_force: FencesInForce = field(default_factory=FencesInForce)
    """Fences of the autopilot that the companion was given in this flight."""
    _sent_s: OrderedDict[bytes, tuple[float, int]] = field(default_factory=OrderedDict, repr=False)
    _sent_count: int = 0

    def report(self, invariant: str, what: str, numbers: Mapping[str, float] | None = None) -> None:
        """Report that an invariant does not hold now."""
        kind = (invariant, what)
        self.counts[kind] = self.counts.get(kind, 0) + 1
        if self.counts[kind] <= MAX_PER_KIND:
            self.violations.append(InvariantViolation(self.now_s, invariant, what, numbers or {}))

    def remember(self, frame: Frame) -> None:
        """Handle a frame that the vehicle sent."""
        self._sent_s.pop(frame.data, None)
        self._sent_count += 1
        self._sent_s[frame.data] = (frame.time_s, self._sent_count)
        if len(self._sent_s) > REMEMBERED:
            self._sent_s.popitem(last=False)

    def sent_at(self, frame: Frame) -> tuple[float, int]:
        """Return time and sequence number at which the vehicle sent a frame; now, if unknown."""
        return self._sent_s.get(frame.data, (frame.time_s, self._sent_count))

    def is_of_autopilot(self, frame: Frame) -> bool:
        """Return True if its sender ids are those of the vehicle's autopilot."""
        return frame.sender == (self.system_id, AUTOPILOT_COMPONENT)

    def observe(self, frame: Frame) -> None:
        """Take a frame that the companion had to accept."""
        if not self.is_of_autopilot(frame) or frame.number not in OBSERVED_MESSAGES:
            return
        observed, message = self.observed, frame.message
        match message:
            case mavlink.MAVLink_heartbeat_message():
                observed.heartbeat_s = frame.time_s
                sent_at = self.sent_at(frame)
                if sent_at >= observed.mode_sent_at:
                    observed.mode_sent_at = sent_at
                    is_armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
                    was_ours, observed.is_ours = observed.is_ours, is_armed and is_offboard(message)
                    if was_ours and not observed.is_ours:
                        observed.left_s = frame.time_s
            case mavlink.MAVLink_local_position_ned_message():
                self._note_position(message, frame.time_s, self.sent_at(frame))
            case mavlink.MAVLink_gps_global_origin_message():
                position = (message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1e3)
                world = self.world_origin
                if world is not None and abs(position[0]) <= 90.0 and abs(position[1]) <= 180.0:
                    self._note_origin(world.enu_from_geodetic(*position), self.sent_at(frame))

    def _note_origin(self, origin_enu_m: PositionEnu, sent_at: tuple[float, int]) -> None:
        observed = self.observed
        if sent_at < observed.origin_sent_at:
            return
        observed.origin_sent_at = sent_at
        if math.dist(origin_enu_m, observed.origin_enu_m) > FRAME_STEP_M:
            position, before = observed.position_enu_m, observed.origin_enu_m
            if position is not None and observed.position_s is not None:
                moved = [
                    at + new - old
                    for at, new, old in zip(position, origin_enu_m, before, strict=True)
                ]
                observed.else_at = ((moved[0], moved[1], moved[2]), observed.position_s)
            observed.frame_sent_at = sent_at
        observed.origin_enu_m = origin_enu_m

    def _note_position(
        self,
        message: mavlink.MAVLink_local_position_ned_message,
        now_s: float,
        sent_at: tuple[float, int],
    ) -> None:
        observed = self.observed
        if sent_at < observed.frame_sent_at:
            return
        values = (message.x, message.y, message.z, message.vx, message.vy, message.vz)
        if not all(abs(value) < 1e5 for value in values):
            return
        has_rebooted = message.time_boot_ms < observed.position_boot_ms - 5000
        is_older = message.time_boot_ms < observed.position_boot_ms and not has_rebooted
        if is_older and not (self._sent_s and sent_at[0] > observed.position_sent_s):
            return  # overtaken; one that was truly sent later is of a clock that slipped
        if has_rebooted and observed.position_enu_m is not None and observed.position_s is not None:
            observed.else_at = (observed.position_enu_m, observed.position_s)
        observed.position_boot_ms = message.time_boot_ms
        observed.position_s, observed.position_sent_s = now_s, sent_at[0]
        observed.position_enu_m = self.world_from_local((message.y, message.x, -message.z))
        observed.velocity_enu_mps = (message.vy, message.vx, -message.vz)

    @property
    def flown_fences(self) -> list[FlownFence]:
        """Return the autopilot's fences that the companion has known for an answer's time."""
        if not self.rules.keeps_autopilot_fence:
            return []
        return self.in_force.known(self.now_s - self.rules.answer_s - TICK_S)

    def depth_m(self, position: Point) -> float:
        """Return the depth inside all fences and outside all keep-outs, m; negative: violated."""
        depth = independent_checks.depth_m(
            self.rules.fence_enu_m, self.rules.keep_out_enu_m, position
        )
        return min([depth, *(fence.depth_m(position) for fence in self.flown_fences)])

    def is_way_clear(self, start: Point, end: Point) -> bool:
        """Return True if the straight line between two points inside crosses no border."""
        rules = self.rules
        return independent_checks.is_way_clear(
            rules.fence_enu_m, rules.keep_out_enu_m, start, end
        ) and all(fence.is_way_clear(start, end) for fence in self.flown_fences)

    def note_fence(self, frame: Frame) -> None:
        """Take a frame that the companion had to accept, if it belongs to the autopilot's fence."""
        world = self.world_origin
        if world is None or not self.is_of_autopilot(frame):
            return
        self.in_force.take(
            frame, lambda lat, lon: world.enu_from_geodetic(lat, lon, world.altitude_m)[:2]
        )

    @property
    def seen_at(self) -> tuple[tuple[PositionEnu, float], ...]:
        """Positions that the companion may assume for the vehicle, each with its arrival time.

        That is the newest; and, while it would not be stale, the last one before the stamps went
        back, because some such stamps are not proof yet that the vehicle restarted, or the newest
        in the frame of an origin that was reported after it.
        """
        observed, oldest_s = self.observed, self.now_s - self.rules.state_age_s - TICK_S
        newest, other = (observed.position_enu_m, observed.position_s), observed.else_at
        positions = [] if newest[0] is None or newest[1] is None else [(newest[0], newest[1])]
        if other is not None and other[1] >= oldest_s:
            positions.append(other)
        return tuple(positions)

    def is_moved_inwards(self, position: Point) -> bool:
        """Return True if a vehicle at a border, or beyond it, may stay at `position`."""
        observed = self.observed.position_enu_m
        return observed is not None and independent_checks.is_moved_inwards(
            self.depth_m(observed[:2]), observed[:2], position
        )

    def world_from_local(self, enu_m: PositionEnu) -> PositionEnu:
        """Convert by the origin last reported to the companion."""
        origin = self.observed.origin_enu_m
        return (enu_m[0] + origin[0], enu_m[1] + origin[1], enu_m[2] + origin[2])

    def setpoint_of(self, frame: Frame) -> SentSetpoint | None:
        """Return the setpoint in a frame that the companion sent, or None for other messages."""
        message = frame.message
        match message:
            case mavlink.MAVLink_set_position_target_local_ned_message():
                position = self.world_from_local((message.y, message.x, -message.z))
            case mavlink.MAVLink_set_position_target_global_int_message():
                world = self.world_origin
                if world is None:
                    return None
                position = world.enu_from_geodetic(
                    message.lat_int / 1e7, message.lon_int / 1e7, message.alt
                )
            case _:
                return None
        return SentSetpoint(frame.time_s, position, message)


@dataclass(slots=True)
class TrueScene(ObservedScene):
    """A scene in which the truth is known."""

    vehicle: SimVehicle = field(kw_only=True)

    def __post_init__(self) -> None:
        """Begin with the current state of the vehicle."""
        self.look_at(self.vehicle)

    def look_at(self, vehicle: SimVehicle) -> None:
        """Process the vehicle's current state."""
        self.vehicle = vehicle
        self.system_id = vehicle.system_id
        self.is_px4 = vehicle.scenario.autopilot.flavour == "px4"
        self.world_origin = vehicle.estimator.world_origin
        self.home_up_m = vehicle.home_enu_m[2]
        self.height_error_m = abs(vehicle.estimator.bias_enu_m[2])
        self.is_flying = vehicle.is_armed or not vehicle.body.is_on_ground

    @property
    def bias_m(self) -> float:
        """Horizontal error of the autopilot's position estimate, m."""
        return math.hypot(*self.vehicle.estimator.bias_enu_m[:2])


class Invariant:
    """Invariant of one flight; a subclass overrides the handlers of the events it needs."""

    name = "I0"
    title = ""

    def __init__(self, scene: ObservedScene) -> None:
        self.scene = scene

    def report(self, what: str, **numbers: float) -> None:
        """Report that it does not hold now."""
        self.scene.report(self.name, what, numbers)

    def setpoint(self, setpoint: SentSetpoint) -> None:
        """Handle a setpoint of the companion."""

    def sent(self, frame: Frame) -> None:
        """Handle a frame of the companion, setpoints included."""

    def heard(self, frame: Frame) -> None:
        """Handle a frame that reached the companion, after the scene did."""

    def stepped(self) -> None:
        """Handle a physics step of the vehicle."""

    def ticked(self) -> None:
        """Handle the end of the companion's control tick."""

    def noted(self, kind: str, fields: Mapping[str, object]) -> None:
        """Handle a journal entry of the companion."""

    def started(self) -> None:
        """Handle the start of the companion process."""

    def mode_chosen(self, mode: FlightMode) -> None:
        """Handle a mode switch by a person."""
