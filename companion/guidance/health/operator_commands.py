"""HOLD, RESUME, RETURN and GRANT, beside the mode switch: their effect, and the answer.

Every command is answered with a text: accepted, or refused with the reason. Views ask for the
objection beforehand, so that a button without effect is grey and shows the reason.
"""

from __future__ import annotations

from companion.domain import FlightMode
from companion.guidance import events
from companion.guidance.commands import Announce, Severity
from companion.guidance.context import SessionContext
from companion.guidance.events import OperatorCommand
from companion.guidance.findings import Finding, Reason, Verdict, Watch
from companion.guidance.phases import IN_CONTROL, Phase, Trigger

HELD = Finding(Verdict.HOLD, Reason.OPERATOR_HOLDS, "operator requested hold")
RETURNS = Finding(
    Verdict.HAND_BACK, Reason.OPERATOR_RETURNS, "operator requested return", FlightMode.RETURN
)
NOT_IN_CONTROL = {
    Phase.WAITING: "not ready yet",
    Phase.STANDBY: "not in control yet",
    Phase.LAUNCHING: "taking off",
    Phase.FINISHED: "the search is over",
    Phase.YIELD: "you fly",
    Phase.HANDBACK: "handing back",
    Phase.STOPPED: "ended",
}


class OperatorCommandWatch(Watch):
    """Executes the operator's commands; a hold ends with the control it was requested in."""

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._finding: Finding | None = None

    def objection(self, command: OperatorCommand) -> str | None:
        """Return why a command would have no effect now, in a few words; None: it has one."""
        if command is OperatorCommand.GRANT:
            return self._objection_to_grant()
        if self._context.phase not in IN_CONTROL:
            return NOT_IN_CONTROL[self._context.phase]
        if command is OperatorCommand.RESUME:
            return None if self._finding is HELD else "not held by HOLD"
        is_asked = self._finding is (HELD if command is OperatorCommand.HOLD else RETURNS)
        return "done already" if is_asked else None

    def _objection_to_grant(self) -> str | None:
        context, phase = self._context, self._context.phase
        if context.fencing.refusal is not None:
            return "no control without a fence"
        if context.vehicle.objection is not None:
            return context.vehicle.objection
        if phase in IN_CONTROL:
            return "in control already"
        if phase is Phase.STANDBY:
            return f"not needed: switch to {context.vehicle.guided_name}"
        if phase is Phase.WAITING and context.authority.may_begin:
            return "not needed: not ready yet"
        is_obeyed = phase in (Phase.WAITING, Phase.YIELD, Phase.FINISHED)
        return None if is_obeyed else NOT_IN_CONTROL[phase]

    def handle(self, event: events.Event) -> None:
        """Execute or refuse a command, and answer it."""
        if not isinstance(event, events.OperatorCommandReceived):
            return
        context, name = self._context, event.command.name
        objection = self.objection(event.command)
        if objection is not None:
            text = f"{name} refused: {objection}"
            context.send(Announce(Severity.WARNING, text, must_pass=True))
            return
        text = f"{name} accepted"
        match event.command:
            case OperatorCommand.HOLD:
                self._finding = HELD
            case OperatorCommand.RESUME:
                self._finding = None
            case OperatorCommand.RETURN:
                self._finding = RETURNS
            case OperatorCommand.GRANT:
                context.enter(Trigger.GRANTED, event.time_s)
                text += f": switch to {context.vehicle.guided_name}"
        context.announce(Severity.NOTICE, text)

    def step(self, now_s: float) -> Finding | None:
        """Return the finding of the operator's command, which is dropped when control ends."""
        del now_s
        if self._context.phase not in IN_CONTROL:
            self._finding = None
        return self._finding
