"""The pilot's sticks: the scenario's transmitter, or a station's joystick over MAVLink."""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.mav.dialect import mavlink
from sim_link.autopilot.scenario import RcParams

STICK_RANGE = 1000.0
"""MANUAL_CONTROL's full deflection."""
JOYSTICK_TIMEOUT_S = 0.5
"""A joystick that has been silent for this long is gone (PX4 COM_RC_LOSS_T)."""
MOVED = 0.3
"""Deflection that takes over from an automatic mode (PX4 COM_RC_STICK_OV, 30 %)."""
DEAD_ZONE = 0.1
"""Deflection up to which a stick is let go (PX4 MPC_HOLD_DZ)."""


@dataclass(frozen=True, slots=True)
class Sticks:
    """Deflections, -1 to 1; all of them 0 when nobody touches them."""

    forward: float = 0.0
    right: float = 0.0
    up: float = 0.0
    yaw: float = 0.0
    """Clockwise positive."""

    @property
    def are_moved(self) -> bool:
        """Whether somebody wants to take over."""
        return self._deflection > MOVED

    @property
    def are_let_go(self) -> bool:
        """Whether nobody flies."""
        return self._deflection <= DEAD_ZONE

    @property
    def _deflection(self) -> float:
        return max(abs(self.forward), abs(self.right), abs(self.up), abs(self.yaw))


CENTRED = Sticks()


def sticks_from(message: mavlink.MAVLink_manual_control_message) -> Sticks:
    """The deflections of MANUAL_CONTROL; an axis beyond its range is not there, and centred.

    Source: MAVLink common, MANUAL_CONTROL (INT16_MAX: the axis is invalid; z is thrust, 500 is
    half); PX4 `handle_message_manual_control` takes no axis beyond 1000 either.
    """
    forward, right, thrust, yaw = (
        value / STICK_RANGE if abs(value) <= STICK_RANGE else math.nan
        for value in (message.x, message.y, message.z, message.r)
    )
    axes = (forward, right, 2.0 * thrust - 1.0, yaw)
    forward, right, up, yaw = (0.0 if math.isnan(axis) else max(-1.0, axis) for axis in axes)
    return Sticks(forward, right, up, yaw)


class StickInput:
    """Whoever holds the sticks now.

    Args:
        params: The transmitter.
    """

    def __init__(self, params: RcParams) -> None:
        self._params = params
        self._joystick: Sticks = CENTRED
        self._joystick_s: float | None = None
        self._moved: Sticks = CENTRED
        self._moved_until_s = -math.inf
        self._lost_until_s = -math.inf

    def take_joystick(self, sticks: Sticks, now_s: float) -> None:
        """Deflections from MANUAL_CONTROL or RC_CHANNELS_OVERRIDE."""
        self._joystick = sticks
        self._joystick_s = now_s

    def move(self, sticks: Sticks, until_s: float) -> None:
        """The pilot holds the transmitter's sticks like this for some time."""
        self._moved, self._moved_until_s = sticks, until_s

    def lose(self, until_s: float) -> None:
        """The transmitter is not heard for some time."""
        self._lost_until_s = until_s

    def is_joystick_alive(self, now_s: float) -> bool:
        """Whether a station's joystick still reports."""
        return self._joystick_s is not None and now_s - self._joystick_s < JOYSTICK_TIMEOUT_S

    def has_transmitter(self, now_s: float) -> bool:
        """Whether the transmitter is heard."""
        is_there = self._params.is_present or now_s < self._moved_until_s
        return is_there and now_s >= self._lost_until_s

    def read(self, now_s: float) -> Sticks | None:
        """The deflections, or None if nobody holds any sticks."""
        if self.is_joystick_alive(now_s):
            return self._joystick
        if not self.has_transmitter(now_s):
            return None
        return self._moved if now_s < self._moved_until_s else CENTRED
