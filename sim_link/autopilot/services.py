"""MAVLink services of one vehicle: from a received message to its answers.

Theory of operation. Every service is a small state machine of `protocols`, which knows nothing of
physics; this joins them to the vehicle. A message that is addressed elsewhere never gets here past
`is_for_us`. Answers name the link they go to; messages for all name none.

Services that the vehicle does not have (files, logs) are refused at once instead of by a silence.
A calibration has no effect, but takes time and reports progress.

Source: MAVLink developer guide, "File Transfer Protocol (FTP)" and "Long Running Commands"; MAVLink
common, LOG_REQUEST_LIST and MAV_CMD_PREFLIGHT_CALIBRATION.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from companion.mav.dialect import MAVLink_command_cancel_message, Message, mavlink
from companion.mav.payloads import IdentifiedMissionCurrent
from sim_link.autopilot.control_inputs import (
    AttitudeTarget,
    GlobalTarget,
    LocalTarget,
    Sticks,
    TargetMessage,
    is_on_earth,
    sticks_from,
)
from sim_link.autopilot.flavour import ACCEPTED, DENIED, UNSUPPORTED
from sim_link.autopilot.protocols.addressing import (
    Addressing,
    Channel,
    LinkSetup,
    Outgoing,
    Partner,
    StatusTexts,
    partner_of,
)
from sim_link.autopilot.protocols.command_protocol import (
    UNANSWERED,
    UNKNOWN_PROGRESS,
    Cancel,
    Clocks,
    Command,
    CommandResult,
    Commands,
)
from sim_link.autopilot.protocols.message_streams import MessageRequests
from sim_link.autopilot.protocols.mission_protocol import Plans
from sim_link.autopilot.protocols.parameter_protocol import Parameters
from sim_link.autopilot.protocols.plan_items import (
    CurrentChosen,
    PlanChanged,
    PlanItem,
    PlanResult,
    PlanStore,
    PlanType,
)
from sim_link.autopilot.telemetry import build_message, mission_progress
from sim_link.autopilot.vehicle import SimVehicle

FTP_HEADER_LENGTH, FTP_PAYLOAD_LENGTH = 12, 251
FTP_ACK, FTP_NAK = 128, 129
FTP_ENDS_SESSIONS = (0, 1, 2)
"""None, TerminateSession and ResetSessions, which have nothing to do and succeed."""
FTP_FILE_NOT_FOUND = 10


def reject_unsupported_service(message: Message, partner: Partner) -> list[Outgoing]:
    """Answer a request of files or logs that is for us; any other gets no answer."""
    answer: Message | None = None
    if isinstance(message, mavlink.MAVLink_file_transfer_protocol_message):
        answer = _no_such_file(bytes(message.payload), partner)
    if isinstance(message, mavlink.MAVLink_log_request_list_message):
        answer = mavlink.MAVLink_log_entry_message(0, 0, 0, 0, 0)
    return [] if answer is None else [Outgoing(answer, partner.channel)]


def _no_such_file(request: bytes, partner: Partner) -> Message | None:
    """Return the NAK of an FTP request; None for a reply."""
    opcode = request[3]
    if opcode >= FTP_ACK:
        return None
    sequence = (int.from_bytes(request[:2], "little") + 1) & 0xFFFF
    is_done = opcode in FTP_ENDS_SESSIONS
    error = b"" if is_done else bytes((FTP_FILE_NOT_FOUND,))
    head = sequence.to_bytes(2, "little")
    head += bytes((request[2], FTP_ACK if is_done else FTP_NAK, len(error), opcode))
    payload = (head.ljust(FTP_HEADER_LENGTH, b"\0") + error).ljust(FTP_PAYLOAD_LENGTH, b"\0")
    return mavlink.MAVLink_file_transfer_protocol_message(0, *partner.ids, list(payload))


CALIBRATION_COMMAND = mavlink.MAV_CMD_PREFLIGHT_CALIBRATION
CALIBRATION_S = 3.0
CALIBRATION_REPORT_S = 0.5


class SensorCalibration:
    """Calibration of a sensor, at most one at a time."""

    def __init__(self, commands: Commands, empty: CommandResult) -> None:
        self._commands = commands
        self._empty = empty
        self._started_s = 0.0
        self._report_s = 0.0

    def begin(self, command: Command, now_s: float) -> CommandResult:
        """Start the requested calibration; without one, return the configured result."""
        if not any(value > 0.0 for value in command.params):
            return self._empty
        self._started_s = now_s
        self._report_s = now_s + CALIBRATION_REPORT_S
        return CommandResult.IN_PROGRESS

    def step(self, now_s: float) -> list[Outgoing]:
        """Return the messages on progress and end."""
        if now_s < self._report_s or not self._commands.is_running(CALIBRATION_COMMAND):
            return []
        self._report_s = now_s + CALIBRATION_REPORT_S
        share = (now_s - self._started_s) / CALIBRATION_S
        if share >= 1.0:
            return self._commands.finish(CALIBRATION_COMMAND, CommandResult.ACCEPTED, now_s)
        return self._commands.report(CALIBRATION_COMMAND, round(100.0 * share), now_s)


NEUTRAL_US, RANGE_US = 1500.0, 500.0
COMMANDS = (
    mavlink.MAVLink_command_long_message,
    mavlink.MAVLink_command_int_message,
    mavlink.MAVLink_set_mode_message,
    MAVLink_command_cancel_message,
)
Handler = Callable[[Any, Partner, float], Message | None]
IsKnown = Callable[[int, int], bool]
"""Predicate for a system and component that were heard, so that messages for them are forwarded."""


class Services:
    """Microservices of one vehicle: commands, parameters, plans, clocks and other requests."""

    def __init__(self, vehicle: SimVehicle, links: Sequence[LinkSetup], is_known: IsKnown) -> None:
        self._vehicle = vehicle
        self._is_known = is_known
        flavour = vehicle.flavour
        firmware = self._firmware = flavour.firmware
        self._texts = StatusTexts()
        self.addressing = Addressing(
            vehicle.system_id, is_known=is_known if firmware.answers_for_others else None
        )
        self.clocks = Clocks(
            self.addressing,
            vehicle.clock.read_s,
            names_targets=firmware.names_timesync_target,
            answers_ping=firmware.answers_ping,
            dated_back_baud=firmware.timesync_dated_back_baud,
        )
        self._parameters = Parameters(flavour.parameters, firmware.parameters, self._texts)
        has_home_item = firmware.first_mission_item == 1
        self._store = PlanStore(self._home_item if has_home_item else None)
        fly_to = self._fly_to if has_home_item else None
        self._plans = Plans(self._store, firmware.plans, self._texts, fly_to)
        self._commands = Commands(firmware.commands)
        self._calibration = SensorCalibration(self._commands, firmware.empty_calibration)
        self._build = partial(build_message, vehicle)
        self.requests = MessageRequests(
            firmware.streams,
            firmware.requests,
            self._build,
            self._texts,
            links,
            flavour.available_modes,
        )
        for link in range(len(links)):
            self.requests.open(Channel(link), 0.0)
        self._progress = mission_progress(vehicle)
        """Progress of the mission as announced last."""
        self._seen = (0, 0, flavour.changes)
        self._owed: list[Outgoing] = []
        """Parameters that changed by themselves."""
        self.wants_reboot = False
        """True if a client requested one."""
        self._handlers = self._handlers_by_type()

    def _handlers_by_type(self) -> dict[type[Message], Handler]:
        """Map message types to handlers, whose results are answered on the sender's channel."""
        return {
            **dict.fromkeys((LocalTarget, GlobalTarget, AttitudeTarget), self._take_setpoint),
            mavlink.MAVLink_heartbeat_message: self._take_heartbeat,
            mavlink.MAVLink_timesync_message: self.clocks.timesync,
            mavlink.MAVLink_ping_message: self.clocks.ping,
            mavlink.MAVLink_manual_control_message: self._take_manual_control,
            mavlink.MAVLink_rc_channels_override_message: self._take_rc_override,
            mavlink.MAVLink_set_gps_global_origin_message: self._take_origin,
            mavlink.MAVLink_request_data_stream_message: self.requests.set_data_stream,
        }

    def handle(self, message: Message, channel: Channel, now_s: float) -> list[Outgoing]:
        """Answer a message that arrived at `now_s` seconds since boot."""
        partner = partner_of(message, channel)
        self.clocks.count(message, partner)
        if self._firmware.rejects_for_others and self._has_unknown_target(message):
            return [self._commands.reject(message, partner)]
        if not self.addressing.is_for_us(message):
            return []
        handler = self._handlers.get(type(message))
        if handler is not None:
            answer = handler(message, partner, now_s)
            answers = [] if answer is None else [Outgoing(answer, channel)]
            return answers + self.announcements()
        if isinstance(message, COMMANDS):
            return self._take_command(message, partner, now_s) + self.announcements()
        outgoing = self._parameters.handle(message, partner, now_s)
        outgoing += self._plans.handle(message, partner, now_s)
        self._take_plan_events()
        return outgoing + reject_unsupported_service(message, partner) + self.announcements()

    def _has_unknown_target(self, message: Message) -> bool:
        """Return True for a command to neither this vehicle nor a component that was heard."""
        if not isinstance(message, COMMANDS[:2]):
            return False
        target = (message.target_system, message.target_component)
        is_ours = target[0] == self._vehicle.system_id and self.addressing.is_for_us(message)
        return not is_ours and not self._is_known(*target)

    def step(self, now_s: float) -> list[Outgoing]:
        """Return the messages due at a physics step."""
        outgoing = self._parameters.handle_timer(now_s) + self._plans.handle_timer(now_s)
        outgoing += self._calibration.step(now_s)
        return outgoing + self.announcements()

    def announcements(self) -> list[Outgoing]:
        """Return texts, and messages that are sent on change."""
        vehicle, aircraft = self._vehicle, self._vehicle.aircraft
        texts, aircraft.texts = aircraft.texts, []
        messages = [each for text in texts for each in self._texts.messages(*text)]
        progress = mission_progress(vehicle)
        reached, aircraft.mission.reached = aircraft.mission.reached, []
        messages += [mavlink.MAVLink_mission_item_reached_message(seq) for seq in reached]
        if progress != self._progress:
            self._progress = progress
            messages.append(IdentifiedMissionCurrent(*progress.fields))
            self._store.current = aircraft.mission.current
        owed, self._owed = self._owed, []
        return owed + [Outgoing(message) for message in messages + self._changed_positions()]

    def _changed_positions(self) -> list[Message]:
        """Return home and origin when they move, and ArduPilot's HEARTBEAT on a mode change."""
        vehicle, aircraft = self._vehicle, self._vehicle.aircraft
        if not vehicle.flavour.has_home(vehicle.time_s):
            return []
        seen = (aircraft.origin_changes, aircraft.home_changes, vehicle.flavour.changes)
        if seen == self._seen:
            return []
        old, self._seen = self._seen, seen
        numbers = []
        if seen[0] != old[0]:
            numbers.append(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)
        if seen[1] != old[1] and old[1]:
            numbers.append(mavlink.MAVLINK_MSG_ID_HOME_POSITION)
        if seen[2] != old[2] and self._firmware.reports_mode_at_once:
            numbers.append(mavlink.MAVLINK_MSG_ID_HEARTBEAT)
        messages = [self._build(number) for number in numbers]
        return [message for message in messages if message is not None]

    def _take_command(self, message: Message, partner: Partner, now_s: float) -> list[Outgoing]:
        command, outgoing = self._commands.receive(message, partner, now_s)
        match command:
            case None:
                return outgoing
            case Cancel():
                cancelled = CommandResult.CANCELLED
                return outgoing + self._commands.finish(command.number, cancelled, now_s)
        answer = self.requests.handle_command(command, now_s)
        result, replies = (self._command(command, now_s), []) if answer is None else answer
        progress = 0 if result == CommandResult.IN_PROGRESS else UNKNOWN_PROGRESS
        if result == UNANSWERED:
            return outgoing
        acknowledgement = self._commands.answer(command, result, now_s, progress=progress)
        return [*outgoing, *replies, acknowledgement]

    def _command(self, command: Command, now_s: float) -> int:
        if command.number == CALIBRATION_COMMAND:
            if self._vehicle.is_armed:
                return self._firmware.busy
            return (
                ACCEPTED
                if self._firmware.calibrates_at_once
                else self._calibration.begin(command, now_s)
            )
        if command.number == mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN:
            if self._vehicle.is_armed:
                return self._firmware.busy
            if command.params[0] != 1.0:  # a shutdown
                return UNSUPPORTED
            self.wants_reboot = True
            return ACCEPTED
        if command.number == mavlink.MAV_CMD_DO_SET_MISSION_CURRENT:
            index = command.whole(1)
            if index is None or not self._store.choose(index):
                return DENIED
            self._take_plan_events()
            return ACCEPTED
        return self._vehicle.flavour.command(command, now_s)

    def _take_plan_events(self) -> None:
        for event in self._store.take_events():
            if self._firmware.gives_plan_ids:
                self._vehicle.aircraft.plan_ids = self._store.ids
            match event:
                case PlanChanged(PlanType.MISSION):
                    self._vehicle.aircraft.mission.load(self._store.items(PlanType.MISSION))
                case PlanChanged(PlanType.FENCE):
                    items = self._store.items(PlanType.FENCE)
                    self._vehicle.aircraft.load_fence(items)
                    self._owed += self._parameters.count_fence(len(items))
                case CurrentChosen():
                    self._vehicle.aircraft.mission.set_current(event.seq)

    def _home_item(self) -> PlanItem:
        lat, lon, alt = self._vehicle.home_e7
        what = (mavlink.MAV_CMD_NAV_WAYPOINT, mavlink.MAV_FRAME_GLOBAL, (0.0, 0.0, 0.0, 0.0))
        return PlanItem(*what, lat, lon, alt / 1e3)

    def _fly_to(self, item: PlanItem) -> PlanResult:
        """Return a "guided" mission item: ArduPilot flies there in GUIDED."""
        command = Command(
            mavlink.MAV_CMD_DO_REPOSITION,
            (-1.0, 0.0, 0.0, math.nan, float(item.x), float(item.y), item.z),
            Partner(Channel(0), 0, 0),
            item.frame,
        )
        result = self._vehicle.flavour.command(command, self._vehicle.time_s)
        return PlanResult.ACCEPTED if result == ACCEPTED else PlanResult.ERROR

    def _take_setpoint(self, message: TargetMessage, _partner: Partner, now_s: float) -> None:
        self._vehicle.flavour.take_setpoint(message, now_s)

    def _take_heartbeat(
        self, message: mavlink.MAVLink_heartbeat_message, partner: Partner, now_s: float
    ) -> None:
        if message.type == mavlink.MAV_TYPE_GCS:
            self._vehicle.aircraft.stations_s[partner.system_id] = now_s

    def _take_manual_control(
        self, message: mavlink.MAVLink_manual_control_message, _partner: Partner, now_s: float
    ) -> None:
        if message.target == self._vehicle.system_id:
            self._vehicle.sticks.take_joystick(sticks_from(message), now_s)

    def _take_rc_override(
        self, message: mavlink.MAVLink_rc_channels_override_message, _partner: Partner, now_s: float
    ) -> None:
        raw = (message.chan1_raw, message.chan2_raw, message.chan3_raw, message.chan4_raw)
        given = [value if 800 <= value <= 2200 else None for value in raw]
        if not self._firmware.obeys_rc_override or given == [None] * 4:
            return
        roll, pitch, throttle, yaw = (
            0.0 if value is None else max(-1.0, min(1.0, (value - NEUTRAL_US) / RANGE_US))
            for value in given
        )
        self._vehicle.sticks.take_joystick(Sticks(-pitch, roll, throttle, yaw), now_s)

    def _take_origin(
        self, message: mavlink.MAVLink_set_gps_global_origin_message, *_: object
    ) -> None:
        position = (message.latitude, message.longitude)
        if self._firmware.takes_origin and is_on_earth(*position):
            self._vehicle.aircraft.set_origin(*position, message.altitude)
