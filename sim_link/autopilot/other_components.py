"""Other MAVLink components behind a vehicle's links: what they send, and as whom.

Each sends a HEARTBEAT a second, and what is typical of it. They are no part of the autopilot, and
are heard on all of its links, as components are whose frames it passes on.

Source: MAVLink common, MAV_COMPONENT and MAV_TYPE; MAVROS2 (`1/191`, TIMESYNC at 10 Hz), STorM32
gimbals (MAV_AUTOPILOT_GENERIC) and mavp2p (system 125, a station without autopilot) as heard.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal, NamedTuple

from companion.mav.codec import MavCodec
from companion.mav.dialect import POSITION_ONLY, Message, mavlink

ComponentName = Literal[
    "gimbal", "camera", "adsb", "router", "station", "mavros", "companion", "tracker", "autopilot"
]


class Identity(NamedTuple):
    """Ids, kind and pace of a component."""

    component_id: int
    mav_type: int
    autopilot: int = mavlink.MAV_AUTOPILOT_INVALID
    system_id: int | None = None
    """None: the vehicle's."""


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
"""Identity of each component; `companion` sends setpoints beside, as a second one of ours does, and
`autopilot` is a second flight controller of the same vehicle."""
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
                zeros = (0.0,) * 8
                return [
                    mavlink.MAVLink_set_position_target_local_ned_message(
                        round(now_s * 1e3),
                        self._vehicle,
                        1,
                        1,
                        POSITION_ONLY,
                        5.0,
                        5.0,
                        -10.0,
                        *zeros,
                    )
                ]
            case "gimbal":
                return [
                    mavlink.MAVLink_mount_orientation_message(
                        round(now_s * 1e3), 0.0, -90.0, 0.0, math.nan
                    )
                ]
        return []
