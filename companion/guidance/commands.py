"""Commands of the session; the link turns these values into messages.

Mission parameters, and those of them that may be changed while the companion runs.

Tuning changes how the mission is flown, never where: fence, keep-outs and the altitude band are
read-only. A change arrives as whole records that were checked together, and takes effect with the
next control tick; the guard moves from one speed to the other within its acceleration, as from one
waypoint to the other.

Gate of all texts for the operator: each cause at most once in a period, within a budget.

Theory of operation. The cause of a text is its wording without numbers, and without the list of
missing inputs. A cause is announced at most once in `CAUSE_PERIOD_S`, however often it
comes and goes. Texts of one topic are states that replace each other, such as "waiting for ..." and
"ready"; there the newest withheld state is announced as soon as its cause may be, unless the topic
has gone back to the announced one. So the last text of a topic is the present state, at the latest
after one period. Changes of control are never withheld: they are answers to the pilot, and guidance
already spaces them.

Announced texts go to the log and the console. On the air they also have to fit into a share of the
slowest downlink, over a sliding minute; errors and changes of control exceed it rather than get
lost.

Source: ArduPilot issue 14034, a position that flaps at 2 Hz; MAVLink common, STATUSTEXT (253).
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Annotated, Any, ClassVar, Literal

import msgspec

from companion.domain import Distance, FlightMode, Params, PositionSetpoint, TargetEstimate, Waiting
from companion.geometry.coordinates import LocalOrigin
from companion.guard.gate import GuardLimits
from companion.planning.planner import Planner


class Severity(Enum):
    """MAV_SEVERITY of a text."""

    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6


class Topic(Enum):
    """Subject whose texts are states: a newer text replaces the one before."""

    READINESS = "readiness"
    """Missing inputs, or readiness for control."""
    PLAN = "plan"
    """Following the plan, slower, or holding, with the reason."""
    CONTACT = "contact"
    """Searching by a pattern, or flying to the target."""


@dataclass(frozen=True, slots=True)
class SendHeartbeat:
    """Send our own HEARTBEAT; it comes from the control tick, so it stops when the tick stops."""


@dataclass(frozen=True, slots=True)
class SendSetpoint:
    """Send a guarded setpoint."""

    setpoint: PositionSetpoint


@dataclass(frozen=True, slots=True)
class SetMode:
    """Request a mode of the autopilot."""

    mode: FlightMode
    is_armed: bool


@dataclass(frozen=True, slots=True)
class Arm:
    """Request arming."""


@dataclass(frozen=True, slots=True)
class TakeOff:
    """Request a take-off."""

    altitude_m: float
    """Height to climb to, above home."""
    home_up_m: float
    """Height of home in the local frame."""


@dataclass(frozen=True, slots=True)
class WithdrawRequest:
    """Withdraw requests that are not answered yet: they must not be sent again."""


@dataclass(frozen=True, slots=True)
class Announce:
    """Show a text to the operator, by log and STATUSTEXT; the link limits its rate."""

    severity: Severity
    text: str
    topic: Topic | str | None = None
    """Subject of the state that the text describes, such as a radio's name; None: an event."""
    must_pass: bool = False
    """True if the rate limit does not apply: control begins or ends, or a find or a grant."""


@dataclass(frozen=True, slots=True)
class ReportResult:
    """Report the localised target."""

    estimate: TargetEstimate
    latitude_deg: float | None
    longitude_deg: float | None
    emitter_id: int | None = None
    origin: LocalOrigin | None = None
    """Zero of the estimate's frame."""
    budget_m: Mapping[str, float] = field(default_factory=dict)
    """R95 in metres after each term that widens it, by the term's name."""


@dataclass(frozen=True, slots=True)
class Record:
    """Write a line to the event log."""

    kind: str
    fields: Mapping[str, object]


Command = (
    SendHeartbeat
    | SendSetpoint
    | SetMode
    | Arm
    | TakeOff
    | WithdrawRequest
    | Announce
    | ReportResult
    | Record
)


StickReaction = Literal["yield", "hold", "ignore"]
Percent = Annotated[float, msgspec.Meta(ge=0.0, le=100.0)]


class SessionParams(Params, frozen=True):
    """Parameters of the mission."""

    engage: Literal["operator", "auto"] = "operator"
    """`operator`: the mode switch hands control over; `auto`: launch once (simulation)."""
    altitude_m: Distance = 20.0
    """Search altitude above home."""
    stop_radius_m: Distance = 1.0
    """R95 below which the target is reported, once it has stayed there for `stop_confirm_s`."""
    stop_confirm_s: Waiting = 10.0
    """Time for which R95 must stay below `stop_radius_m`."""
    settle_s: Waiting | None = 45.0
    """Time in which R95 must improve by 8 %, or the target is reported with the radius that it has;
    null: never."""
    on_localised: Literal["hold", "return", "land"] = "hold"
    """Mode to request after the report, a value of `FlightMode`."""
    searches_on: bool = msgspec.field(default=False, name="continue")
    """True if the search continues for further emitters after a report."""
    ranging_timeout_s: Annotated[float, msgspec.Meta(ge=0.5, le=3600.0)] = 5.0
    """Time without a usable measurement after which the vehicle holds."""
    degraded_after_s: Waiting = 2.0
    """Time without a usable measurement after which the vehicle flies more slowly."""
    coast_drift_mps: ClassVar[float] = 1.0
    """Assumed speed of the target, relative to its estimate, without measurements."""
    coast_sigma_max_m: ClassVar[float] = 30.0
    """Standard deviation of the estimate, without ranging, above which the vehicle holds."""
    on_sticks: StickReaction = "yield"
    """Reaction to a pilot who moves the sticks: `yield` holds, then leaves the vehicle to the
    pilot; `hold` only holds; `ignore` continues."""
    battery_low_pct: Percent = 20.0
    """Charge at which the leg is finished, estimates are reported, and the vehicle returns."""
    battery_critical_pct: Percent = 10.0
    """Charge at which the vehicle is handed back at once by requesting the return."""

    def __post_init__(self) -> None:
        if self.battery_low_pct < self.battery_critical_pct:
            raise ValueError("battery_low_pct must not be below battery_critical_pct")


class When(Enum):
    """State in which a parameter may be changed."""

    ANY_TIME = "at any time but during launch and hand-back"
    DISARMED = "only while the vehicle is disarmed"
    NEVER = "never"


@dataclass(frozen=True, slots=True)
class Tuning:
    """Settings that the parts of a session use."""

    params: SessionParams
    limits: GuardLimits
    """Limits with the fence that the session began with."""
    planner: Planner[Any]
    """Planner of the same kind as before: it continues with the memory of the one before."""


CAUSE_PERIOD_S = 30.0
"""Seconds between two texts of one cause: twice MAVLink's usual link-loss timeout (15 s), and few
enough that ten causes that flap at once stay readable."""
MINUTE_S = 60.0
SHARE_OF_DOWNLINK = 0.01
"""Share of the downlink's capacity for texts; telemetry needs the rest."""
NUMBER = re.compile(r"(?<![\w.])(?<!system )(?<!emitter )-?\d[\d.]*")
"""Figures that do not distinguish causes; the number of a system or an emitter, and one in a name,
do."""
WAITED_FOR = re.compile(r"(?<=\bwaiting for ).*")
"""List of missing inputs, which shrinks after a start: one cause, whatever it contains."""


@dataclass(slots=True)
class _TopicState:
    """Announced state of one topic, and a newer one that is withheld."""

    announced: str = ""
    withheld: Announce | None = None


class TextGate:
    """Filter of the texts that are announced, and of those that are sent by radio.

    Args:
        bytes_per_s: Capacity of the slowest downlink, bytes a second.
    """

    def __init__(self, bytes_per_s: float) -> None:
        self.withheld = 0
        """Texts that were not announced when they came."""
        self.unsent = 0
        """Announced texts that did not fit into the budget of the downlink."""
        self._budget_bytes = SHARE_OF_DOWNLINK * bytes_per_s * MINUTE_S
        self._announced_s: dict[str, float] = {}
        """Time of the last announcement of each cause."""
        self._topics: dict[Topic | str, _TopicState] = {}
        self._sent: deque[tuple[float, int]] = deque()
        self._sent_bytes = 0

    def admit(self, text: Announce, now_s: float) -> bool:
        """Return True if a text is to be announced now; withheld states may become due later."""
        words = NUMBER.sub("#", text.text)
        cause = WAITED_FOR.sub("", words)
        topic = self._topics.setdefault(text.topic, _TopicState()) if text.topic else None
        if topic is not None:
            topic.withheld = None if words == topic.announced else text
        is_recent = now_s - self._announced_s.get(cause, -math.inf) < CAUSE_PERIOD_S
        if is_recent and not text.must_pass:
            self.withheld += 1
            return False
        self._announced_s[cause] = now_s
        if topic is not None:
            topic.announced, topic.withheld = words, None
        self._forget(now_s)
        return True

    def due(self, now_s: float) -> list[Announce]:
        """Return the withheld states whose cause may be announced again now."""
        waiting = [topic.withheld for topic in self._topics.values() if topic.withheld is not None]
        due = []
        for text in waiting:
            before = self.withheld
            if self.admit(text, now_s):
                due.append(text)
            self.withheld = before  # counted when it came
        return due

    def fits(self, text: Announce, size_bytes: int, now_s: float) -> bool:
        """Return True if the downlink may carry a text of this size in bytes, and count it."""
        while self._sent and self._sent[0][0] <= now_s - MINUTE_S:
            self._sent_bytes -= self._sent.popleft()[1]
        is_needed = text.must_pass or text.severity is Severity.ERROR
        if not is_needed and self._sent_bytes + size_bytes > self._budget_bytes:
            self.unsent += 1
            return False
        self._sent.append((now_s, size_bytes))
        self._sent_bytes += size_bytes
        return True

    def _forget(self, now_s: float) -> None:
        """Drop old causes, so that forged texts cannot fill the memory."""
        if len(self._announced_s) > MOST_CAUSES:
            self._announced_s = {
                cause: time_s
                for cause, time_s in self._announced_s.items()
                if now_s - time_s < CAUSE_PERIOD_S
            }


MOST_CAUSES = 256
"""Number of causes at which old ones are dropped."""
