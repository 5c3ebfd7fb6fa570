"""Whose frames an unsigned companion must believe: one address's, until that was silent for long.

The first autopilot that is heard is it, whatever its ids; a companion that was not told which one
to follow, and begins anew beside two, follows for good the one that speaks first.

Without a key an address is all that tells two senders of the same ids apart. The autopilot may come
back from another one, when a router begins anew, so a companion has to follow after a silence; and
then whoever speaks first is the autopilot, an attacker included. What it does from then on follows
from what it had to believe. Only a key prevents that.
"""

from __future__ import annotations

from companion.mav.dialect import mavlink
from sim_link.lockstep.observer import Frame

FOLLOWED = (mavlink.MAV_AUTOPILOT_PX4, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA)
SILENCE_S = 3.0
"""How long one address is silent before the other one is believed."""


class Whose:
    """Follows one of several senders: the vehicle itself, somebody with its ids, or another one.

    Args:
        wanted_system_id: The only one that is followed; None: any.
    """

    def __init__(self, wanted_system_id: int | None = None) -> None:
        self._wanted_system_id = wanted_system_id
        self._ids: tuple[int, int] | None = None
        """Of the autopilot that is followed; None: nobody is yet."""
        self._is_genuine: bool | None = None
        """Whether the vehicle itself is followed."""
        self._heard_s = 0.0

    @property
    def is_a_stranger(self) -> bool:
        """Whether somebody else than the vehicle is followed."""
        return self._is_genuine is False

    def is_beside_a_stranger(self, frame: Frame) -> bool:
        """Whether a frame is of a payload of the stranger who is followed, as its ids say."""
        is_of_it = self._ids is not None and frame.sender[0] == self._ids[0]
        return self.is_a_stranger and is_of_it

    def _may_follow(self, frame: Frame) -> bool:
        message = frame.message
        if not isinstance(message, mavlink.MAVLink_heartbeat_message):
            return False
        is_wanted = self._wanted_system_id in (None, frame.sender[0])
        return is_wanted and message.autopilot in FOLLOWED

    def restart(self) -> None:
        """A companion that starts anew follows the first that it hears."""
        self._ids = self._is_genuine = None

    def believes(self, frame: Frame) -> bool:
        """Whether a readable frame of an autopilot had to be believed."""
        is_new = self._ids is None
        if is_new and not self._may_follow(frame):
            return frame.is_genuine
        self._ids = self._ids or frame.sender
        if frame.sender != self._ids:
            return False
        if is_new or frame.time_s - self._heard_s >= SILENCE_S:
            self._is_genuine = frame.is_genuine
        if frame.is_genuine is not self._is_genuine:
            return False
        self._heard_s = frame.time_s
        return True
