"""Whether the autopilot's own fence is the one that the companion will keep.

The same judgement as in flight, by the same code: what would keep the companion from engaging is a
failure here.
"""

from __future__ import annotations

from collections.abc import Iterator

from companion.config.schema import CompanionConfig
from companion.doctor.facts import AutopilotFacts
from companion.doctor.verdicts import Finding, fail, ok, warn
from companion.guard.gate import Guard
from companion.guidance.fencing import FencePolicy, Fencing

SUBJECT = "fence"
SAME = "upload the same fence to the autopilot, or set limits.autopilot_fence; docs/flying.md"


def check_fence(facts: AutopilotFacts, config: CompanionConfig) -> Iterator[Finding]:
    """Compare the fences as `limits.autopilot_fence` says."""
    fencing = Fencing(Guard(config.limits.guard_limits()), config.limits.fence_plan())
    if facts.origin is not None:
        fencing.set_origin(facts.origin)
    if facts.fence is not None:
        fencing.take(facts.fence)
    if fencing.refusal is not None:
        yield fail(SUBJECT, fencing.refusal, SAME)
    elif fencing.missing:
        text = f"not compared: {' and '.join(fencing.missing)} is not known yet"
        yield warn(SUBJECT, text, "wait for a position fix, and look again")
    elif fencing.note is not None:
        yield warn(SUBJECT, fencing.note, SAME)
    else:
        is_read = fencing.plan.policy is not FencePolicy.IGNORE
        how = "the autopilot's is the same" if is_read else "the autopilot's is not looked at"
        how = "the autopilot's own" if fencing.plan.policy is FencePolicy.USE else how
        yield ok(SUBJECT, f"{fencing.words}; {how}")
