"""The radio payload: a component of its own that measures the emitter and sends what it heard.

A radio that integrates, averages or buffers reports late: what it sends and stamps now it measured
`lag_s` ago, from the place and with the attitude of then.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from companion.domain import PositionEnu
from companion.mav.dialect import Message, mavlink
from companion.mav.ranging import message_from_ranging
from sim_link.autopilot.pilot import STEP_S
from sim_link.autopilot.protocols.message_streams import DUE_TOLERANCE_S
from sim_link.autopilot.scenario import PayloadParams
from sim_link.autopilot.telemetry import MAVLINK_VERSION
from sim_link.world.environment import ChannelParams, Emitter, Environment
from sim_link.world.field_radio import FieldRadio
from sim_link.world.point_mass import EulerAngles, PointMass

COMPONENT_ID = mavlink.MAV_COMP_ID_PERIPHERAL
HEARTBEAT_PERIOD_S = 1.0
COMMANDS = (mavlink.MAVLink_command_long_message, mavlink.MAVLink_command_int_message)


class _Pose(NamedTuple):
    """True pose of the vehicle at a step."""

    position_enu_m: PositionEnu
    height_m: float
    attitude: EulerAngles


class RadioPayload:
    """Measures at a fixed rate while the vehicle is high and near enough.

    Args:
        environment: The obstacles between the two; None: there are none.
    """

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
            stamp_s: What the autopilot's clock shows, by which it stamps.
        """
        messages: list[Message] = []
        if now_s + DUE_TOLERANCE_S >= self._heartbeat_due_s:
            self._heartbeat_due_s = max(self._heartbeat_due_s, now_s - HEARTBEAT_PERIOD_S)
            self._heartbeat_due_s += HEARTBEAT_PERIOD_S
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
                place, attitude = pose.position_enu_m, pose.attitude
                measurement = self._radio.hear(emitter, place, now_s, attitude)
                if measurement is not None:
                    messages.append(message_from_ranging(measurement, stamp_us))
        return messages


def reject_command(message: Message, system_id: int) -> Message | None:
    """Return the ACK of a command for the payload, which knows none; None if it is none for it.

    Source: MAVLink developer guide, "Command Protocol": every command is acknowledged.
    """
    if not isinstance(message, COMMANDS):
        return None
    if (message.target_system, message.target_component) != (system_id, COMPONENT_ID):
        return None
    asker = (message.get_srcSystem(), message.get_srcComponent())
    refusal = (message.command, mavlink.MAV_RESULT_UNSUPPORTED, 0, 0)
    return mavlink.MAVLink_command_ack_message(*refusal, *asker)


def payload_heartbeat() -> Message:
    """Return the HEARTBEAT of a radio payload."""
    kind = (mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID)
    return mavlink.MAVLink_heartbeat_message(*kind, 0, 0, mavlink.MAV_STATE_ACTIVE, MAVLINK_VERSION)
