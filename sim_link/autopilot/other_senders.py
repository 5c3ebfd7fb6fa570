"""Other senders besides the vehicle: its radio payload, components, and a second ground station.

The radio payload measures the emitters and sends the measurements. A radio that integrates,
averages or buffers reports late: what it sends and stamps now it measured `lag_s` ago, at the
position and attitude of that time.

Each other component sends a HEARTBEAT a second, and what is typical of it. They are not part of the
autopilot, and are heard on all of its links, as components are whose frames it passes on.

Source: MAVLink common, MAV_COMPONENT and MAV_TYPE; MAVROS2 (`1/191`, TIMESYNC at 10 Hz), STorM32
gimbals (MAV_AUTOPILOT_GENERIC) and mavp2p (system 125, a station without autopilot) as heard.

The ground station sends the commands of an incident. It has its own link to the vehicle, so the
companion sees only their effects; on a shared link it receives the answers, too.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from companion.domain import PositionEnu
from companion.geometry.coordinates import ned_from_enu
from companion.mav.codec import MavCodec
from companion.mav.dialect import POSITION_ONLY, Message, mavlink, message_from_ranging
from companion.mav.payloads import raw_value
from sim_link.autopilot.flight_controller import STEP_S
from sim_link.autopilot.incidents import (
    ComponentName,
    StationFence,
    StationHome,
    StationParameter,
    StationRates,
    StationRecord,
)
from sim_link.autopilot.protocols.addressing import Channel
from sim_link.autopilot.protocols.message_streams import DUE_TOLERANCE_S, message_id
from sim_link.autopilot.scenario import PayloadParams
from sim_link.autopilot.telemetry import MAVLINK_VERSION
from sim_link.autopilot.vehicle import SimVehicle
from sim_link.world.environment import ChannelParams, Emitter, Environment
from sim_link.world.field_radio import FieldRadio
from sim_link.world.point_mass import EulerAngles, PointMass


class Identity(NamedTuple):
    """Ids, kind and pace of a component."""

    component_id: int
    mav_type: int
    autopilot: int = mavlink.MAV_AUTOPILOT_INVALID
    system_id: int | None = None
    """System id; None: the vehicle's."""


IDENTITIES: Mapping[ComponentName, Identity] = {
    "gimbal": Identity(154, mavlink.MAV_TYPE_GIMBAL, mavlink.MAV_AUTOPILOT_GENERIC),
    "camera": Identity(100, mavlink.MAV_TYPE_CAMERA),
    "adsb": Identity(156, mavlink.MAV_TYPE_ADSB),
    "router": Identity(191, mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_GENERIC, 125),
    "station": Identity(190, mavlink.MAV_TYPE_GCS, system_id=255),
    "mavros": Identity(191, mavlink.MAV_TYPE_ONBOARD_CONTROLLER),
    "companion": Identity(191, mavlink.MAV_TYPE_ONBOARD_CONTROLLER),
    "tracker": Identity(
        1, mavlink.MAV_TYPE_ANTENNA_TRACKER, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 2
    ),
    "autopilot": Identity(2, mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4),
}
"""Identity of each component; `companion` sends setpoints in parallel, as a second one of ours
does, and `autopilot` is a second flight controller of the same vehicle."""
HEARTBEAT_S, STREAM_S = 1.0, 0.1


class OtherComponentSender:
    """Sender of one component, from `began_s` on."""

    def __init__(self, name: ComponentName, vehicle_system_id: int, began_s: float) -> None:
        self._name = name
        self._identity = identity = IDENTITIES[name]
        self._vehicle = vehicle_system_id
        self._codec = MavCodec(identity.system_id or vehicle_system_id, identity.component_id)
        self._heartbeat_s = self._stream_s = began_s

    def frames(self, now_s: float) -> list[bytes]:
        """Return the frames that are due."""
        due: list[Message] = []
        if now_s >= self._heartbeat_s:
            self._heartbeat_s = now_s + HEARTBEAT_S
            identity = self._identity
            due.append(
                mavlink.MAVLink_heartbeat_message(
                    identity.mav_type, identity.autopilot, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
                )
            )
        if now_s >= self._stream_s:
            self._stream_s = now_s + STREAM_S
            due += self._stream(now_s)
        return [self._codec.encode(message) for message in due]

    def _stream(self, now_s: float) -> list[Message]:
        match self._name:
            case "mavros":
                return [mavlink.MAVLink_timesync_message(0, round(now_s * 1e9))]
            case "companion":
                return [setpoint_at((5.0, 5.0, 10.0), self._vehicle, now_s)]
            case "gimbal":
                angles = (0.0, -90.0, 0.0, math.nan)
                return [mavlink.MAVLink_mount_orientation_message(round(now_s * 1e3), *angles)]
        return []


def setpoint_at(position_enu_m: PositionEnu, system_id: int, now_s: float) -> Message:
    """Return the setpoint by which another companion keeps a vehicle at a position."""
    head = (round(1e3 * now_s), system_id, 1, mavlink.MAV_FRAME_LOCAL_NED, POSITION_ONLY)
    position = ned_from_enu(position_enu_m)
    return mavlink.MAVLink_set_position_target_local_ned_message(*head, *position, *[0.0] * 8)


STATION_IDS = (254, mavlink.MAV_COMP_ID_MISSIONPLANNER)
STATION_CHANNEL = Channel(0, ("other station", 0))
"""Separate link on which only this station receives the answers."""
E7 = 1e7
FENCE = mavlink.MAV_MISSION_TYPE_FENCE


def station_orders(incident: StationRecord, vehicle: SimVehicle) -> list[Message]:
    """Return the messages of the station, as the vehicle receives them, in order."""
    target = (vehicle.system_id, mavlink.MAV_COMP_ID_AUTOPILOT1)
    orders: list[Message] = []
    match incident:
        case StationFence():
            orders = _fence_orders(incident, vehicle, target)
        case StationParameter():
            orders = _parameter_orders(incident, vehicle, target)
        case StationRates():
            interval_us = 1e6 / incident.rate_hz if incident.rate_hz > 0.0 else -1.0
            params = (float(message_id(incident.message)), interval_us, *[0.0] * 5)
            number = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
            orders = [mavlink.MAVLink_command_long_message(*target, number, 0, *params)]
        case StationHome():
            position = vehicle.estimator.world_origin.geodetic_from_enu(
                (incident.east_m, incident.north_m, incident.up_m)
            )
            what = (*target, mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_CMD_DO_SET_HOME, 0, 0)
            nothing, at = (0.0, 0.0, 0.0, 0.0), (round(E7 * position[0]), round(E7 * position[1]))
            orders = [mavlink.MAVLink_command_int_message(*what, *nothing, *at, position[2])]
    codec = MavCodec(*STATION_IDS)
    received = (codec.decode_frame(codec.encode(order)) for order in orders)
    return [message for message in received if message is not None]


def _fence_orders(
    incident: StationFence, vehicle: SimVehicle, target: tuple[int, int]
) -> list[Message]:
    """Return an upload, or the clearing of the fence."""
    half_m = incident.half_side_m
    if half_m is None:
        return [mavlink.MAVLink_mission_clear_all_message(*target, FENCE)]
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    corners = [(half_m * east, half_m * north) for east, north in signs]
    command, first = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION, float(len(corners))
    if incident.is_circle:
        command, first = mavlink.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION, half_m
        corners = [(0.0, 0.0)]
    command += 0 if incident.is_inclusion else 1
    messages: list[Message] = [mavlink.MAVLink_mission_count_message(*target, len(corners), FENCE)]
    for seq, (east_m, north_m) in enumerate(corners):
        position = (incident.east_m + east_m, incident.north_m + north_m, 0.0)
        latitude, longitude, _ = vehicle.estimator.world_origin.geodetic_from_enu(position)
        what = (*target, seq, mavlink.MAV_FRAME_GLOBAL, command, 0, 1, first, 0.0, 0.0, 0.0)
        at = (round(E7 * latitude), round(E7 * longitude), 0.0)
        messages.append(mavlink.MAVLink_mission_item_int_message(*what, *at, FENCE))
    return messages


def _parameter_orders(
    incident: StationParameter, vehicle: SimVehicle, target: tuple[int, int]
) -> list[Message]:
    """Return a PARAM_SET; none of a parameter that the autopilot does not have."""
    store = vehicle.flavour.parameters
    index = store.index_of(incident.name)
    if index is None or not math.isfinite(incident.value):
        return []
    kind = store.specs[index].kind
    encoding = vehicle.flavour.firmware.parameters.encoding
    (value,) = struct.unpack("<f", raw_value(incident.value, kind, encoding))
    name = incident.name.encode("ascii")
    return [mavlink.MAVLink_param_set_message(*target, name, value, kind)]


PAYLOAD_ID = mavlink.MAV_COMP_ID_PERIPHERAL
COMMANDS = (mavlink.MAVLink_command_long_message, mavlink.MAVLink_command_int_message)


class _Pose(NamedTuple):
    """True pose of the vehicle at a step."""

    position_enu_m: PositionEnu
    height_m: float
    attitude: EulerAngles


class RadioPayload:
    """Measures at a fixed rate while the vehicle is near and high enough, past any obstacles."""

    def __init__(
        self,
        params: PayloadParams,
        channel: ChannelParams,
        emitters: Sequence[Emitter],
        rng: np.random.Generator,
        environment: Environment | None = None,
    ) -> None:
        self._params = params
        antenna, measures = params.antenna, params.measures
        self._radio = FieldRadio(channel, rng, environment, antenna, measures)
        for emitter in emitters:
            self._radio.prepare(emitter)
        self._poses: deque[_Pose] = deque(maxlen=1 + round(params.lag_s / STEP_S))
        self._emitters = tuple(emitters)
        self._period_s = 1.0 / params.rate_hz
        self._measurement_due_s = 0.0
        self._heartbeat_due_s = 0.0

    def messages(self, body: PointMass, now_s: float, stamp_s: float) -> list[Message]:
        """Return the messages due at `now_s` seconds since boot, from the vehicle's true position.

        Args:
            stamp_s: Reading of the autopilot's clock, used for its stamps.
        """
        messages: list[Message] = []
        if now_s + DUE_TOLERANCE_S >= self._heartbeat_due_s:
            self._heartbeat_due_s = max(self._heartbeat_due_s, now_s - HEARTBEAT_S)
            self._heartbeat_due_s += HEARTBEAT_S
            messages.append(payload_heartbeat())
        is_due = now_s + DUE_TOLERANCE_S >= self._measurement_due_s
        if is_due or self._params.lag_s > 0.0:
            self._poses.append(_Pose(body.position_enu_m, body.height_m, body.attitude))
        if is_due:
            self._measurement_due_s = max(self._measurement_due_s, now_s - self._period_s)
            self._measurement_due_s += self._period_s
            messages += self._measured(self._poses[0], now_s, round(1e6 * stamp_s))
        return messages

    def _measured(self, pose: _Pose, now_s: float, stamp_us: int) -> list[Message]:
        messages = []
        for emitter in self._emitters:
            is_near = emitter.slant_range_m(pose.position_enu_m) <= self._params.max_range_m
            if is_near and pose.height_m >= self._params.min_altitude_m:
                position, attitude = pose.position_enu_m, pose.attitude
                measurement = self._radio.hear(emitter, position, now_s, attitude)
                if measurement is not None:
                    messages.append(message_from_ranging(measurement, stamp_us))
        return messages


def reject_command(message: Message, system_id: int) -> Message | None:
    """Return the ACK of a command to the payload, which supports none; None for other messages.

    Source: MAVLink developer guide, "Command Protocol": every command is acknowledged.
    """
    if not isinstance(message, COMMANDS):
        return None
    if (message.target_system, message.target_component) != (system_id, PAYLOAD_ID):
        return None
    asker = (message.get_srcSystem(), message.get_srcComponent())
    refusal = (message.command, mavlink.MAV_RESULT_UNSUPPORTED, 0, 0)
    return mavlink.MAVLink_command_ack_message(*refusal, *asker)


def payload_heartbeat() -> Message:
    """Return the HEARTBEAT of a radio payload."""
    kind = (mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID)
    return mavlink.MAVLink_heartbeat_message(*kind, 0, 0, mavlink.MAV_STATE_ACTIVE, MAVLINK_VERSION)
