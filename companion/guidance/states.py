"""Who flies: the companion's authority as a transition table.

Theory of operation. The companion commands only while the autopilot is in offboard mode *and* the
operator gave it that mode; everything else is either getting there or staying out of the way.

    WAITING    no autopilot, or no usable position or home yet. Silent.
    STANDBY    ready; streams "stay here" so that the mode can be entered (PX4 refuses offboard
               without a stream). The operator switches the mode, or in auto the launch begins.
    LAUNCHING  auto only, once: arm, take off, ask for offboard.
    ENGAGED    offboard and armed: flies what the planner wants, through the guard.
    HOLDING    offboard and armed, but something the plan stands on is missing (ranging, own
               position, a filter that makes sense): streams "stay here".
    FINISHED   the target was reported; the autopilot was asked for the mode that follows, and
               gets "stay here" until it has left offboard, never again after that.
    YIELDED    the mode left offboard for whatever reason: silence, latched. Only the operator
               ends it, by giving offboard again (on the ground, or with another source of
               setpoints), by an explicit grant, or by disarming (the next flight is a new one).
    HANDING_BACK  asked to stop while in control: asks for the autopilot's own hold mode and
               gives it "stay here" until it confirms.
    STOPPED    the process may end.

Three rules stand above the table: a lost mode is never asked for again; what was asked and not
answered is withdrawn when control ends; and a setpoint leaves only in STREAMING phases, from the
control tick.
"""

from __future__ import annotations

from enum import Enum


class Phase(Enum):
    """Where the session stands; see the theory of operation above."""

    WAITING = "waiting"
    STANDBY = "standby"
    LAUNCHING = "launching"
    ENGAGED = "engaged"
    HOLDING = "holding"
    FINISHED = "finished"
    YIELDED = "yielded"
    HANDING_BACK = "handing back"
    STOPPED = "stopped"


class Trigger(Enum):
    """What moves the session from one phase to another."""

    READY = "autopilot, position and home are known"
    LAUNCH = "automatic launch begins"
    LAUNCH_FAILED = "automatic launch gave up"
    MODE_GIVEN = "offboard and armed"
    MODE_LOST = "the mode left offboard"
    GRANTED = "the operator grants control again"
    DISARMED = "disarmed"
    INPUT_LOST = "something the plan stands on is missing"
    INPUT_BACK = "everything the plan stands on is there"
    LOCALISED = "the target is reported"
    RESTARTED = "the autopilot restarted"
    STOP = "asked to stop"
    HANDED_BACK = "the hand-back is over"


IN_CONTROL = frozenset({Phase.ENGAGED, Phase.HOLDING})
"""Phases in which the vehicle obeys our setpoints."""

STREAMING = IN_CONTROL | {
    Phase.STANDBY,
    Phase.LAUNCHING,
    Phase.FINISHED,
    Phase.HANDING_BACK,
}
"""Phases in which setpoints may be sent at all."""

OUT_OF_CONTROL = frozenset({Phase.WAITING, Phase.YIELDED, Phase.STOPPED})
"""Phases in which nothing may be asked of the autopilot, nor asked again."""

TRANSITIONS: dict[tuple[Phase, Trigger], Phase] = {
    (Phase.WAITING, Trigger.READY): Phase.STANDBY,
    (Phase.STANDBY, Trigger.LAUNCH): Phase.LAUNCHING,
    (Phase.STANDBY, Trigger.MODE_GIVEN): Phase.HOLDING,
    (Phase.LAUNCHING, Trigger.MODE_GIVEN): Phase.HOLDING,
    (Phase.LAUNCHING, Trigger.LAUNCH_FAILED): Phase.YIELDED,
    (Phase.LAUNCHING, Trigger.MODE_LOST): Phase.YIELDED,
    (Phase.HOLDING, Trigger.INPUT_BACK): Phase.ENGAGED,
    (Phase.ENGAGED, Trigger.INPUT_LOST): Phase.HOLDING,
    (Phase.ENGAGED, Trigger.LOCALISED): Phase.FINISHED,
    (Phase.ENGAGED, Trigger.MODE_LOST): Phase.YIELDED,
    (Phase.HOLDING, Trigger.MODE_LOST): Phase.YIELDED,
    (Phase.YIELDED, Trigger.GRANTED): Phase.STANDBY,
    (Phase.YIELDED, Trigger.MODE_GIVEN): Phase.HOLDING,
    (Phase.FINISHED, Trigger.GRANTED): Phase.STANDBY,
    (Phase.ENGAGED, Trigger.STOP): Phase.HANDING_BACK,
    (Phase.HOLDING, Trigger.STOP): Phase.HANDING_BACK,
    (Phase.LAUNCHING, Trigger.STOP): Phase.HANDING_BACK,
    (Phase.FINISHED, Trigger.STOP): Phase.HANDING_BACK,
    (Phase.HANDING_BACK, Trigger.HANDED_BACK): Phase.STOPPED,
    (Phase.HANDING_BACK, Trigger.MODE_LOST): Phase.STOPPED,
    (Phase.HANDING_BACK, Trigger.DISARMED): Phase.STOPPED,
}
TRANSITIONS |= {
    (phase, Trigger.STOP): Phase.STOPPED for phase in (Phase.WAITING, Phase.STANDBY, Phase.YIELDED)
}
TRANSITIONS |= {
    (phase, Trigger.RESTARTED): Phase.WAITING
    for phase in Phase
    if phase not in (Phase.HANDING_BACK, Phase.STOPPED)
}
TRANSITIONS |= {
    (phase, Trigger.DISARMED): Phase.WAITING
    for phase in (Phase.LAUNCHING, Phase.ENGAGED, Phase.HOLDING, Phase.YIELDED, Phase.FINISHED)
}


def next_phase(phase: Phase, trigger: Trigger) -> Phase:
    """The phase after a trigger; a trigger that means nothing in a phase leaves it as it is."""
    return TRANSITIONS.get((phase, trigger), phase)
