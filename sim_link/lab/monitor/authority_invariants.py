"""I3, I7, I8 and I13: setpoints by authority only, without a pause, with an end; few texts."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

from companion.domain import FlightMode
from companion.mav.dialect import mavlink
from sim_link.lab.monitor.scene import (
    ARDUPILOT_GUIDED,
    PX4_OFFBOARD_MAIN,
    TICK_S,
    Invariant,
    ObservedScene,
    SentSetpoint,
    is_offboard,
)
from sim_link.lab.observer import Frame

EPSILON_S = 1e-6
HERE_M = 2.0
QUIET_S = 2.0
"""Time of silence after control was taken by choice."""
BY_STICKS = "the pilot moves the sticks"
"""The companion's word for the one end of control in its own mode that is a person's choice."""
GRANT_S = 3.0
"""Longest delay of a mode's loss: a grant after it belongs to the time after that mode."""
RAISES = (
    mavlink.MAV_CMD_DO_SET_MODE,
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM,
    mavlink.MAV_CMD_NAV_TAKEOFF,
)
"""Commands that take or transfer control."""
FAILSAFE = mavlink.MAV_STATE_CRITICAL
HEARD = frozenset({mavlink.MAVLINK_MSG_ID_HEARTBEAT, mavlink.MAVLINK_MSG_ID_COMMAND_LONG})
RECOVERY_S = 2.0
"""Time to learn the mode after a stall: requested each 250 ms, over a link that loses."""
HEARTBEATS_S = 1.5
"""Longest gap of HEARTBEATs, which autopilots send every second."""


class OnlyWithAuthority(Invariant):
    """No setpoint and no request of a mode without the operator's consent.

    Control that was lost is free again once HEARTBEATs without a failsafe have shown another mode
    for `QUIET_S`: then setpoints may come that move nothing, and a person may select the mode.
    After a failsafe, and after an end of control that the companion chose, only a grant frees it,
    or the end of the flight.
    """

    name = "I3"
    title = "silence within a tick of the first foreign mode, and nothing is taken back"
    late = 0
    """Setpoints and requests later than a tick after the frame that ended control."""
    worst_late_s = 0.0
    _was_ours = False
    _ours_sent_at = (-1.0, 0)
    _lost_s: float | None = None
    _aside_s: float | None = None
    """Time since which another mode is shown without a failsafe after control was lost."""
    _is_barred = False
    """True if control was lost and returns only by a grant."""
    _given_s = -1.0
    """Time at which a person selected the mode again after its loss, or since the process began."""
    _may_engage = True
    _granted_s = -math.inf
    _is_launching = False

    def started(self) -> None:
        """Forbid a process started next to a flying vehicle to take it by itself."""
        self._was_ours, self._given_s = False, -1.0
        self._free()
        self._may_engage = not self.scene.is_flying
        self._is_launching = False

    def noted(self, kind: str, fields: Mapping[str, object]) -> None:
        """Mark control as lost until it is handed over again, even in its mode."""
        if kind != "phase":
            return
        self._is_launching = fields.get("new") == "launching"
        if fields.get("new") != "yield":
            return
        if fields.get("old") in ("handback", "launching"):
            self._lose(is_barred=True)
        elif self.scene.observed.is_ours:
            self._lose(is_barred=fields.get("trigger") != BY_STICKS)

    def _lose(self, *, is_barred: bool) -> None:
        self._is_barred |= is_barred
        if self._lost_s is None:
            self._lost_s, self._given_s, self._aside_s = self.scene.now_s, -1.0, None

    def _free(self) -> None:
        self._lost_s, self._aside_s, self._is_barred = None, None, False

    def mode_chosen(self, mode: FlightMode) -> None:
        """Handle a mode switch; a return to offboard by the autopilot gives no control."""
        self._given_s = self.scene.now_s if mode is FlightMode.OFFBOARD else -1.0

    def heard(self, frame: Frame) -> None:
        """Follow the mode, and the operator's grants."""
        if not self.scene.must_accept or frame.number not in HEARD:
            return
        message = frame.message
        if isinstance(message, mavlink.MAVLink_command_long_message):
            if message.command == mavlink.MAV_CMD_NAV_GUIDED_ENABLE and message.param1 == 1.0:
                self._was_ours &= self._lost_s is None  # a grant takes nothing away
                self._may_engage = True
                self._free()
                self._granted_s = self.scene.now_s
            return
        is_autopilot = self.scene.is_of_autopilot(frame)
        if isinstance(message, mavlink.MAVLink_heartbeat_message) and is_autopilot:
            self._follow(message, self.scene.sent_at(frame))

    def _follow(
        self, heartbeat: mavlink.MAVLink_heartbeat_message, sent_at: tuple[float, int]
    ) -> None:
        now_s = self.scene.now_s
        is_live = bool(heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        is_failsafe = heartbeat.system_status == FAILSAFE
        if is_live and self._is_launching and is_failsafe:
            self._lose(is_barred=True)
        if is_live and is_offboard(heartbeat):
            self._aside_s = None
            if sent_at[0] >= self._granted_s:
                self._granted_s = -math.inf  # taken up
            is_given = sent_at[0] >= self._given_s >= 0.0
            if self._lost_s is None and (self._may_engage or is_given):
                self._was_ours = True
                self._ours_sent_at = max(self._ours_sent_at, sent_at)
            return
        if sent_at <= self._ours_sent_at:
            return
        if not is_live:  # the flight is over, and the next one is a new one
            self._was_ours, self._may_engage = False, True
            self._free()
        elif now_s - self._granted_s < GRANT_S:  # of a mode that was lost before the grant
            self._was_ours = False
        elif self._was_ours:
            self._follow_loss(is_failsafe=is_failsafe)

    def _follow_loss(self, *, is_failsafe: bool) -> None:
        """Handle another mode while control is lost."""
        now_s = self.scene.now_s
        self._lose(is_barred=is_failsafe)
        if is_failsafe:
            self._aside_s = None
        elif self._aside_s is None:
            self._aside_s = now_s
        elif not self._is_barred and now_s - self._aside_s >= QUIET_S - EPSILON_S:
            self._was_ours = self._may_engage = False  # until a person selects the mode
            self._free()

    def setpoint(self, setpoint: SentSetpoint) -> None:
        """Judge whether it may be sent at all."""
        if self._is_late("a setpoint after the mode was lost"):
            return
        if self._was_ours or self.scene.is_lied_to:
            return
        position = setpoint.position_enu_m[:2]
        seen = [seen_enu_m[:2] for seen_enu_m, _ in self.scene.seen_at]
        away = min((math.dist(position, there) for there in seen), default=math.inf)
        if away <= HERE_M + self.scene.rules.clearance_m:
            return
        if not self.scene.is_moved_inwards(position):
            self.report("a setpoint that moves before control was given", away_m=away)

    def sent(self, frame: Frame) -> None:
        """Judge requests of the companion that change mode or control."""
        message = frame.message
        match message:
            case mavlink.MAVLink_set_mode_message():
                self._is_late("a mode request after the mode was lost")
            case mavlink.MAVLink_command_long_message() | mavlink.MAVLink_command_int_message() if (
                message.command in RAISES
            ):
                if self._is_late("a request after the mode was lost"):
                    return
                ours = PX4_OFFBOARD_MAIN if self.scene.is_px4 else ARDUPILOT_GUIDED
                is_hand_back = message.command == mavlink.MAV_CMD_DO_SET_MODE
                is_hand_back = is_hand_back and message.param2 != ours
                if not self._may_engage and not is_hand_back:
                    self.report("took a flying vehicle by itself", command=message.command)

    def _is_late(self, what: str) -> bool:
        if self._lost_s is None:
            return False
        late_s = self.scene.now_s - self._lost_s
        if late_s <= self.scene.rules.answer_s + EPSILON_S:
            return False
        self.late += 1
        self.worst_late_s = max(self.worst_late_s, late_s)
        self.report(what, late_s=late_s)
        return True


class KeepsStreaming(Invariant):
    """In control, a setpoint leaves at least every 100 ms, outside of stalls.

    In a stall the companion first has to learn again who flies and where it is: its process got no
    time, no mode was heard for long, the local frame moved, or it took control a moment ago. A
    stall ends with the next setpoint, or a while after the companion has all that it needs.
    """

    name = "I7"
    title = "in control the stream of setpoints does not pause"
    PHASES = frozenset({"normal", "degraded", "hold"})

    def __init__(self, scene: ObservedScene) -> None:
        super().__init__(scene)
        self.worst_gap_s = 0.0
        self._is_in_control = False
        self._since_s = 0.0
        self._last_s: float | None = None
        self._is_stalled = False
        self._excused_s = self._settled_s = -math.inf
        """Time until which a pause is excused by a stall, or by a local frame that moved."""
        self._frame_sent_at = scene.observed.frame_sent_at

    def noted(self, kind: str, fields: Mapping[str, object]) -> None:
        """Track the state that the companion reports."""
        if kind == "phase":
            self._is_stalled |= not self._is_in_control
            self._is_in_control = fields.get("new") in self.PHASES
            self._since_s = self.scene.now_s

    def started(self) -> None:
        """Forget all claims at the start of a process."""
        self._is_in_control, self._last_s = False, None
        self._is_stalled, self._excused_s = False, -math.inf

    def setpoint(self, setpoint: SentSetpoint) -> None:
        """Judge the gap before it; a setpoint ends a stall."""
        self._judge(setpoint.time_s)
        self._is_stalled, self._excused_s = False, -math.inf
        self._last_s = setpoint.time_s

    def stepped(self) -> None:
        """Time passes without a setpoint."""
        self._judge(self.scene.now_s)

    def _judge(self, now_s: float) -> None:
        scene = self.scene
        self._look_for_stall(now_s)
        is_in_control = self._is_in_control and scene.is_companion_up and scene.observed.is_ours
        if not is_in_control or scene.observed.heartbeat_s is None:
            self._last_s = None
            return
        is_excused = scene.is_lied_to or now_s <= max(self._excused_s, self._settled_s)
        if self._last_s is None or is_excused:
            self._last_s = now_s
            return
        gap_s = now_s - max(self._last_s, self._since_s, scene.suspended_until_s)
        self.worst_gap_s = max(self.worst_gap_s, gap_s)
        if gap_s > scene.rules.gap_s + EPSILON_S:
            self.report("the stream paused while in control", gap_s=gap_s)
            self._last_s = now_s

    def _look_for_stall(self, now_s: float) -> None:
        scene, observed = self.scene, self.scene.observed
        silent_s = 0.0 if observed.heartbeat_s is None else now_s - observed.heartbeat_s
        if scene.suspended_until_s >= now_s or silent_s >= scene.rules.silence_s - TICK_S:
            self._is_stalled, self._excused_s = True, now_s + RECOVERY_S
        most_s = scene.rules.state_age_s
        if observed.frame_sent_at != self._frame_sent_at:
            self._frame_sent_at = observed.frame_sent_at
            self._is_stalled, self._settled_s = True, now_s + most_s
        is_lost = observed.position_s is None or now_s - observed.position_sent_s > most_s - TICK_S
        if self._is_stalled and (is_lost or silent_s > HEARTBEATS_S):
            self._excused_s = now_s + RECOVERY_S


class SilentWithoutTick(Invariant):
    """Heartbeat and setpoints stop where the control tick stalls."""

    name = "I8"
    title = "without the control tick there is no heartbeat and no setpoint"
    _started_s = 0.0

    def started(self) -> None:
        """Wait for the first tick of a new process."""
        self._started_s = self.scene.now_s

    def sent(self, frame: Frame) -> None:
        """Judge by when the tick ran last."""
        message = frame.message
        is_vital = isinstance(
            message,
            mavlink.MAVLink_heartbeat_message
            | mavlink.MAVLink_set_position_target_local_ned_message
            | mavlink.MAVLink_set_position_target_global_int_message,
        )
        if not is_vital:
            return
        tick_s = self._started_s if self.scene.tick_s is None else self.scene.tick_s
        stalled_s = frame.time_s - tick_s
        if stalled_s > self.scene.rules.stall_s:
            self.report("sent although the control tick stalled", stalled_s=stalled_s)


PERIOD_S = 30.0
CHUNK = 50
"""Bytes of a STATUSTEXT; a shorter chunk is the last one of its text."""
FIGURE = re.compile(r"(?<!system )(?<!emitter )\d+(\.\d+)*")
"""Figures, without which the words are a text's cause; not the number of an emitter."""
BY_A_PERSON = frozenset({"COMMAND_LONG", "COMMAND_INT", "SET_MODE", "PARAM_SET"})
"""Messages that the companion answers with a text every time."""


class FewTexts(Invariant):
    """A text is not sent twice within 30 s, figures apart.

    What a person did since allows it once more: a changed mode, arming, or an order that was heard.
    """

    name = "I13"
    title = "texts with the same cause are sent once in 30 s, or in answer to a person"

    def __init__(self, scene: ObservedScene) -> None:
        super().__init__(scene)
        self._chunks: tuple[int, dict[int, str]] = (0, {})
        """Id of the text that is being sent, and its chunks by number."""
        self._last: dict[str, tuple[float, int]] = {}
        """Time at which a cause was sent last, and the number of operator actions by then."""
        self._deeds = 0
        self._flown: tuple[int, int] | None = None
        """Mode and flags of the autopilot's last HEARTBEAT."""

    def started(self) -> None:
        """A new process has said nothing yet."""
        self._last.clear()

    def heard(self, frame: Frame) -> None:
        """Count changes of mode and arming, and orders."""
        scene, message = self.scene, frame.message
        if message is None or not (scene.must_accept or scene.is_indistinct):
            return
        if message.get_type() in BY_A_PERSON:
            self._deeds += 1
        elif isinstance(message, mavlink.MAVLink_heartbeat_message) and scene.is_of_autopilot(
            frame
        ):
            flown = (message.custom_mode, message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            self._deeds += flown != self._flown
            self._flown = flown

    def sent(self, frame: Frame) -> None:
        """Join the chunks of a text, and judge it once it is whole."""
        message = frame.message
        if not isinstance(message, mavlink.MAVLink_statustext_message):
            return
        number, chunks = self._chunks
        if message.id == 0 or message.id != number:
            self._chunks = number, chunks = message.id, {}
        if message.chunk_seq in chunks:
            return  # to another link
        chunks[message.chunk_seq] = message.text
        if message.id == 0 or len(message.text.encode("utf-8")) < CHUNK:
            self._judge("".join(chunks[each] for each in sorted(chunks)))

    def _judge(self, text: str) -> None:
        now_s, cause = self.scene.now_s, FIGURE.sub("#", text)
        before_s, deeds = self._last.get(cause, (-PERIOD_S, self._deeds))
        self._last[cause] = (now_s, self._deeds)
        is_copy = now_s - before_s < TICK_S  # for another link
        if now_s - before_s < PERIOD_S and deeds == self._deeds and not is_copy:
            self.report(f"the same text again: {cause}", after_s=now_s - before_s)
