"""Control authority as a transition table.

Theory of operation. The companion commands only while the autopilot is in offboard mode *and* the
operator selected that mode; every other phase either prepares for this or is silent.

    WAITING    no autopilot, or no usable position, home or fence yet, or a second companion sends
               under our ids. Silent.
    STANDBY    ready; streams "stay here" so that the mode can be entered (PX4 refuses offboard
               without a stream). The operator switches the mode, or in auto the launch begins.
    LAUNCHING  auto only, once: arm, take off, request offboard.
    NORMAL     offboard and armed: follows the planner, through the guard.
    DEGRADED   the same, slower: ranging ages, and the target position is extrapolated.
    HOLD       offboard and armed, but an input is bad (ranging, vehicle position, a diverged
               filter, the autopilot's health): streams "stay here".
    FINISHED   the target was reported and the mode that follows was requested; streams "stay here"
               until the autopilot has left offboard, never again after that.
    YIELD      another source has control: the mode left offboard for whatever reason, the vehicle
               lands, others send setpoints or move the sticks, or it was handed back. Silence. A
               mode that a person chose ends it once it has stayed for a while: then WAITING, and
               ready again as before the first time. Everything else is latched until an explicit
               grant, or until the vehicle is disarmed (the next flight is a new one).
    HANDBACK   asked to stop while in control, or a fault does not pass: requests the autopilot's
               own hold, or the return, once, and streams "stay here" until it answers. Then YIELD,
               and STOPPED if that was requested.
    STOPPED    the process may end.

Control begins only by MODE_GIVEN: a HEARTBEAT shows offboard and armed, `Authority` finds that the
operator selected it, the mode is confirmed as current (`ModeWatch`), the fence is ready and no
other system sends under our ids; `Handover` checks all of these. In auto, `Launch` leads up to it.

Control is kept: at every tick `ControlTick` asks the `Watches` for the worst finding: SLOW
(DEGRADED), HOLD, HAND_BACK or YIELD; without a finding the phase is NORMAL.

Control ends by the autopilot's reports (MODE_LOST, LANDED, DISARMED, RESTARTED: `Handover`), by its
identity on the link (NOT_OURS), by a verdict (HAND_BACK, CONTENTION, PILOT_TOOK), by a stop, or by
the report. `Authority` decides which reports have to follow before the mode counts as selected
again, and which ends of control need a grant.

Three rules stand above the table: a lost mode is never requested again; unanswered requests are
withdrawn when control ends; and a setpoint is sent only in STREAMING phases, from the control tick.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum


class Phase(Enum):
    """Phase of the session; see the theory of operation above."""

    WAITING = "waiting"
    STANDBY = "standby"
    LAUNCHING = "launching"
    NORMAL = "normal"
    DEGRADED = "degraded"
    HOLD = "hold"
    FINISHED = "finished"
    YIELD = "yield"
    HANDBACK = "handback"
    STOPPED = "stopped"

    __hash__ = object.__hash__  # that of Enum is written in Python, and phases are looked up often


PHASE_NAMES = {
    Phase.WAITING: "waiting for the autopilot",
    Phase.STANDBY: "ready: switch the mode to hand over control",
    Phase.LAUNCHING: "launching",
    Phase.NORMAL: "searching",
    Phase.DEGRADED: "searching slowly",
    Phase.HOLD: "holding in place",
    Phase.FINISHED: "search over",
    Phase.YIELD: "silent: pilot or another system has control",
    Phase.HANDBACK: "handing the vehicle back",
    Phase.STOPPED: "stopped",
}
"""Names of the phases for the operator."""


class Trigger(Enum):
    """Cause that moves the session from one phase to another."""

    READY = "autopilot, position, home and fence are known"
    FENCE_LOST = "the fence is not known any more, or refused"
    ID_CONFLICT = "another system sends under our ids"
    LAUNCH = "automatic launch begins"
    LAUNCH_FAILED = "automatic launch gave up"
    MODE_GIVEN = "offboard and armed"
    MODE_LOST = "the mode left offboard"
    GRANTED = "the operator granted control again"
    DISARMED = "disarmed"
    LANDED = "landing, or on the ground after a flight"
    INPUT_AGES = "an input of the plan is ageing"
    INPUT_LOST = "an input of the plan is missing"
    INPUT_BACK = "all inputs of the plan are available"
    LOCALISED = "the target is reported, or the battery is low"
    HAND_BACK = "a fault persists"
    CONTENTION = "another system commands"
    PILOT_TOOK = "the pilot moves the sticks"
    MODE_LEFT = "another mode was selected, and kept"
    NOT_OURS = "the vehicle is unsupported, or not the one handed over"
    RESTARTED = "the autopilot restarted"
    STOP = "stop requested"
    HANDED_BACK = "the hand-back is over"
    YIELD_RECALLED = "it had yielded before the process restarted"
    REPORT_RECALLED = "it had reported before the process restarted"


FLYING = frozenset({Phase.NORMAL, Phase.DEGRADED})
"""Phases in which the vehicle follows the plan."""

IN_CONTROL = FLYING | {Phase.HOLD}
"""Phases in which the vehicle obeys our setpoints."""

HAS_VEHICLE = IN_CONTROL | {Phase.FINISHED, Phase.HANDBACK}
"""Phases in which the companion controls the vehicle, or did a moment ago."""

STREAMING = IN_CONTROL | {Phase.STANDBY, Phase.LAUNCHING, Phase.FINISHED, Phase.HANDBACK}
"""Phases in which setpoints may be sent at all."""

OUT_OF_CONTROL = frozenset({Phase.WAITING, Phase.YIELD, Phase.STOPPED})
"""Phases in which nothing may be requested of the autopilot, nor requested again."""

_ROWS: tuple[tuple[Iterable[Phase], Trigger, Phase], ...] = (
    ({Phase.WAITING}, Trigger.READY, Phase.STANDBY),
    ({Phase.STANDBY}, Trigger.FENCE_LOST, Phase.WAITING),
    ({Phase.STANDBY}, Trigger.ID_CONFLICT, Phase.WAITING),
    ({Phase.STANDBY}, Trigger.NOT_OURS, Phase.WAITING),
    (HAS_VEHICLE | {Phase.LAUNCHING}, Trigger.NOT_OURS, Phase.YIELD),
    ({Phase.STANDBY}, Trigger.LAUNCH, Phase.LAUNCHING),
    ({Phase.LAUNCHING}, Trigger.LAUNCH_FAILED, Phase.YIELD),
    ({Phase.STANDBY, Phase.LAUNCHING}, Trigger.MODE_GIVEN, Phase.HOLD),
    ({Phase.HOLD, Phase.DEGRADED}, Trigger.INPUT_BACK, Phase.NORMAL),
    ({Phase.HOLD, Phase.NORMAL}, Trigger.INPUT_AGES, Phase.DEGRADED),
    (FLYING, Trigger.INPUT_LOST, Phase.HOLD),
    (IN_CONTROL, Trigger.LOCALISED, Phase.FINISHED),
    ({Phase.YIELD, Phase.FINISHED}, Trigger.GRANTED, Phase.STANDBY),
    (IN_CONTROL, Trigger.HAND_BACK, Phase.HANDBACK),
    (IN_CONTROL, Trigger.CONTENTION, Phase.YIELD),
    (IN_CONTROL, Trigger.PILOT_TOOK, Phase.YIELD),
    ({Phase.YIELD}, Trigger.MODE_LEFT, Phase.WAITING),
    (IN_CONTROL | {Phase.LAUNCHING, Phase.HANDBACK}, Trigger.MODE_LOST, Phase.YIELD),
    (HAS_VEHICLE, Trigger.LANDED, Phase.YIELD),
    ({Phase.HANDBACK}, Trigger.HANDED_BACK, Phase.YIELD),
    (IN_CONTROL | {Phase.LAUNCHING, Phase.FINISHED}, Trigger.STOP, Phase.HANDBACK),
    ({Phase.WAITING, Phase.STANDBY, Phase.YIELD}, Trigger.STOP, Phase.STOPPED),
    ({Phase.WAITING, Phase.STANDBY}, Trigger.YIELD_RECALLED, Phase.YIELD),
    ({Phase.WAITING, Phase.STANDBY}, Trigger.REPORT_RECALLED, Phase.FINISHED),
    (HAS_VEHICLE | {Phase.LAUNCHING, Phase.YIELD}, Trigger.DISARMED, Phase.WAITING),
    (set(Phase) - {Phase.STOPPED}, Trigger.RESTARTED, Phase.WAITING),
)
TRANSITIONS = {
    (phase, trigger): following for phases, trigger, following in _ROWS for phase in phases
}


def next_phase(phase: Phase, trigger: Trigger) -> Phase:
    """Return the phase after a trigger; a trigger without a transition does not change it."""
    return TRANSITIONS.get((phase, trigger), phase)
