"""Modes beyond a firmware's table: ArduPilot's mode 30, where the vehicle offers it.

All ArduPilot vehicles reserve number 30, OFFBOARD, for an external controller's mode. None has it
by itself; a script may register it, and the vehicle then lists it in AVAILABLE_MODES and flies it
as GUIDED. So the list is requested when an autopilot is bound, again when AVAILABLE_MODES_MONITOR
announces a change, and when a mode appears that the list did not have. A vehicle that is found in
mode 30 has to leave it once: otherwise the answer alone would look like a mode switch.

Source: MAVLink common, AVAILABLE_MODES and "Standard Flight Modes" protocol; ArduPilot #28939,
#28110; ArduCopter 4.5 answers FAILED.
"""

from __future__ import annotations

import math

from companion.domain import Autopilot
from companion.link.outbound import Ids, VehicleCommand
from companion.mav.dialect import Message, mavlink
from companion.mav.flight_modes import OFFBOARD_NUMBER

FIRST_RETRY_S = 1.0
MOST_ASKS = 4
"""Requests with growing intervals; an autopilot without the message rejects each."""
ALL_MODES = 0.0
"""Second parameter of the request."""


class OfferedModes:
    """Query for the modes that one autopilot offers."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Start again, because the autopilot restarted or was replaced."""
        self.understands_offboard = False
        """True if mode 30 obeys setpoints, and was offered before it was selected."""
        self._is_offered = False
        self._list_number: int | None = None
        self._ask_again()

    def _ask_again(self) -> None:
        self._heard: set[int] = set()
        self._is_complete = False
        self._asks, self._next_s = 0, -math.inf

    def due(self, now_s: float, autopilot: Autopilot, target: Ids) -> Message | None:
        """Return the request to send now, if any; an incomplete list is requested again."""
        is_over = self._is_complete or self._asks >= MOST_ASKS
        if autopilot is not Autopilot.ARDUPILOT or is_over or now_s < self._next_s:
            return None
        self._next_s = now_s + FIRST_RETRY_S * 2**self._asks
        self._asks += 1
        params = (float(mavlink.MAVLINK_MSG_ID_AVAILABLE_MODES), ALL_MODES)
        return VehicleCommand(mavlink.MAV_CMD_REQUEST_MESSAGE, params).message(target)

    def receive(self, message: Message) -> None:
        """Process a message of the autopilot."""
        match message:
            case mavlink.MAVLink_heartbeat_message():
                if message.custom_mode != OFFBOARD_NUMBER:
                    self.understands_offboard = self._is_offered
                elif not self._is_offered and self._is_complete:
                    self._ask_again()
            case mavlink.MAVLink_available_modes_message():
                self._heard.add(message.mode_index)
                self._is_complete = len(self._heard) >= message.number_modes
                self._is_offered |= message.custom_mode == OFFBOARD_NUMBER
            case mavlink.MAVLink_available_modes_monitor_message():
                if message.seq != self._list_number:
                    self._list_number = message.seq
                    self._is_offered = False
                    self._ask_again()
