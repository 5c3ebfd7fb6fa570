"""Mission script: scenario, steps and expected results of one flight.

A script is a scenario (origin, vehicle, emitters, channel, obstacles, weather; all its keys are the
script's own) with the companion's configuration, steps and expectations, each of which has a name
and gets a verdict at the end. `script_file` reads it from YAML and checks what no single record
can see.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Literal, Union, get_args, get_type_hints

import msgspec
from msgspec import UNSET, UnsetType

from companion.config.schema import CompanionConfig
from companion.domain import Params
from companion.mav.dialect import mavlink
from companion.planning.search import Spacing
from sim_link.autopilot.scenario import FlavourName, FlightAltitude, Scenario
from sim_link.lab.faults.fault_models import Fault
from sim_link.world.environment import Coordinate, EmitterId

Source = Literal["companion", "autopilot"]
INVARIANTS = tuple(f"I{number}" for number in range(1, 13))
NEVER_JUDGED = {"I10", "I12"}
"""Invariants that a single flight cannot show: see missions.md."""
NotNegative = Annotated[float, msgspec.Meta(ge=0.0)]


class Bound(Params, frozen=True):
    """Limits of a number that is never negative; one of them at least."""

    at_most: NotNegative | None = None
    at_least: NotNegative | None = None

    def __post_init__(self) -> None:
        """Raise `ValueError` for a bound without a limit, and for one that no value can meet."""
        if self.at_most is None and self.at_least is None:
            raise ValueError("give at_most, at_least or both")
        if self.at_most is not None and self.at_least is not None and self.at_least > self.at_most:
            raise ValueError("nothing is at least at_least and at most at_most: they are swapped")

    def holds(self, value: float) -> bool:
        """Return True if a value is within the bounds."""
        is_low = self.at_most is None or value <= self.at_most
        return is_low and (self.at_least is None or value >= self.at_least)

    def __str__(self) -> str:
        low = "" if self.at_least is None else f"at least {self.at_least:g}"
        high = "" if self.at_most is None else f"at most {self.at_most:g}"
        return " and ".join(part for part in (low, high) if part)


def _one_given(record: Params, what: str) -> str:
    """Return the one key of a record besides its name; `ValueError`: not exactly one is given."""
    names = [name for name in record.__struct_fields__ if name != "name"]
    given = [name for name in names if getattr(record, name) is not UNSET]
    if len(given) != 1:
        found = " and ".join(given) if given else "none"
        raise ValueError(f"{what} is exactly one of its kinds, not {found}")
    return given[0]


class EmitterBound(Bound, frozen=True):
    """Bound on a figure of one emitter."""

    emitter: EmitterId | None = None
    """Id of the emitter; null: the scenario's `emitter`."""


class TextSeen(Params, frozen=True):
    """A text for the operator, or a message by its MAVLink name."""

    text: str | None = None
    message: str | None = None
    """MAVLink name of the message, for example RADIO_RANGING."""
    from_: Source | None = msgspec.field(default=None, name="from")
    """System id of the sender; null: any."""

    def __post_init__(self) -> None:
        if (self.text is None) == (self.message is None):
            raise ValueError("give either text or message")
        if not (self.text or self.message):
            raise ValueError("an empty text is part of every text")


class Appears(TextSeen, frozen=True):
    """Text or message that must have been sent."""

    at_least: Annotated[int, msgspec.Meta(ge=1)] = 1


class Violations(Params, frozen=True):
    """Violations of the companion's invariants that are allowed."""

    at_most: Annotated[int, msgspec.Meta(ge=0)] = 0
    invariants: tuple[str, ...] = INVARIANTS
    """Invariants that count."""

    def __post_init__(self) -> None:
        for name in self.invariants:
            if name not in INVARIANTS:
                raise ValueError(f"there is no invariant {name}: I1 to I13 are")
        if not set(self.invariants) - NEVER_JUDGED:
            raise ValueError("invariants: none that a flight can judge; leave the list out")


class Expectation(Params, frozen=True, kw_only=True):
    """One expectation: a name and exactly one of the other keys."""

    name: Annotated[str, msgspec.Meta(min_length=1, max_length=100)]
    final_error_m: EmitterBound | UnsetType = UNSET
    """Distance of the last estimate from the true emitter."""
    error_over_r95: EmitterBound | UnsetType = UNSET
    """Error in units of R95: at most 1 in 95 of 100 flights if R95 is consistent and the vehicle
    position is exact."""
    error_over_absolute_r95: EmitterBound | UnsetType = UNSET
    """Error in units of the absolute R95, which includes the error of the vehicle position."""
    reported_s: EmitterBound | UnsetType = UNSET
    """Time of the report of the target, since the first hand-over."""
    time_s: Bound | UnsetType = UNSET
    distance_m: Bound | UnsetType = UNSET
    violations: Violations | UnsetType = UNSET
    """Limit of violations of the invariants I1 to I13."""
    appears: Appears | UnsetType = UNSET
    never: TextSeen | UnsetType = UNSET
    """Text or message that must not have been sent."""
    holds: str | UnsetType = UNSET
    """Condition that is true at the end."""
    always: str | UnsetType = UNSET
    """Condition that is true from the first step to the last."""

    def __post_init__(self) -> None:
        _one_given(self, "an expectation")

    @property
    def kind(self) -> str:
        """Kind of the expectation."""
        return _one_given(self, "an expectation")


PatternName = Literal["lawnmower", "expanding_square", "sector"]
PilotMode = Literal["hold", "position", "altitude", "stabilized", "return", "land"]
Corner = tuple[Coordinate, Coordinate]
LONGEST_S = 86_400.0
Limit = Annotated[float, msgspec.Meta(gt=0.0, le=LONGEST_S)]
Duration = Annotated[float, msgspec.Meta(ge=0.0, le=LONGEST_S)]


class StepParams(Params, frozen=True):
    """Parameters of a step, whose type identifies the step."""


class ConnectStep(StepParams, frozen=True):
    """Wait until operator and companion hear the autopilot."""

    limit_s: Limit = 30.0


class WaitReadyStep(StepParams, frozen=True):
    """Wait until the autopilot can be armed and the companion stands by."""

    limit_s: Limit = 120.0


class ArmStep(StepParams, frozen=True):
    """Step in which the operator arms."""

    limit_s: Limit = 15.0


class TakeoffStep(StepParams, frozen=True):
    """The operator takes off; over once the height is reached."""

    altitude_m: FlightAltitude | None = None
    """Height above home; null: the companion's search altitude."""
    limit_s: Limit = 90.0


class EngageStep(StepParams, frozen=True):
    """The operator hands over control (PX4 OFFBOARD, ArduPilot GUIDED); over once it is taken."""

    limit_s: Limit = 10.0


class GrantStep(StepParams, frozen=True):
    """The operator lets a companion that yielded stand by, or fly, again (NAV_GUIDED_ENABLE)."""

    limit_s: Limit = 10.0


class SearchStep(StepParams, frozen=True):
    """The companion flies a pattern, its `planner.search`; over with contact, or a target."""

    pattern: PatternName = "lawnmower"
    spacing_m: Spacing | None = None
    """Distance between lanes or legs; null: the companion's own."""
    area_enu_m: tuple[Corner, ...] | None = None
    """Corners of the area that a lawnmower sweeps; null: the companion's own."""
    until: Literal["contact", "reported"] = "contact"
    limit_s: Limit = 120.0


class WaitUntilStep(StepParams, frozen=True, kw_only=True):
    """Wait until a condition holds."""

    condition: str
    limit_s: Limit
    for_s: Duration = 0.0
    """Time for which the condition must be true without a break."""


class WaitStep(StepParams, frozen=True, kw_only=True):
    """Advance the time."""

    for_s: Limit


class PilotOverrideStep(StepParams, frozen=True):
    """The pilot switches the mode; over once the vehicle is in it and the companion has yielded."""

    mode: PilotMode = "hold"
    limit_s: Limit = 10.0

    @property
    def needs_sticks(self) -> bool:
        """True if the vehicle then follows the sticks."""
        return self.mode in ("position", "altitude", "stabilized")


class HoldStep(StepParams, frozen=True):
    """The operator lets the vehicle hold its position for a time."""

    for_s: Duration = 0.0
    limit_s: Limit = 15.0


class ReturnStep(StepParams, frozen=True):
    """The operator requests the return; over once the vehicle is home and disarmed."""

    limit_s: Limit = 240.0


class LandStep(StepParams, frozen=True):
    """The operator lands; over once the vehicle stands, disarmed."""

    limit_s: Limit = 120.0


StepWord = Literal[
    "connect", "wait_ready", "arm", "takeoff", "engage", "grant", "search", "pilot_override",
    "hold", "return", "land",
]  # fmt: skip
"""Steps that need no parameters may be a word alone."""


class StepRecord(Params, frozen=True, rename={"return_": "return"}):
    """One step: exactly one of these keys; its value may be left out where all have defaults."""

    connect: ConnectStep | UnsetType | None = UNSET
    wait_ready: WaitReadyStep | UnsetType | None = UNSET
    arm: ArmStep | UnsetType | None = UNSET
    takeoff: TakeoffStep | UnsetType | None = UNSET
    engage: EngageStep | UnsetType | None = UNSET
    grant: GrantStep | UnsetType | None = UNSET
    search: SearchStep | UnsetType | None = UNSET
    wait_until: WaitUntilStep | UnsetType = UNSET
    wait: WaitStep | UnsetType = UNSET
    pilot_override: PilotOverrideStep | UnsetType | None = UNSET
    inject: Fault | UnsetType = UNSET
    """Fault of the harness, `start_s` after this step begins; the mission continues."""
    hold: HoldStep | UnsetType | None = UNSET
    return_: ReturnStep | UnsetType | None = UNSET
    land: LandStep | UnsetType | None = UNSET

    def __post_init__(self) -> None:
        _one_given(self, "a step")


Step = StepParams | Fault

STEP_KINDS: dict[str, type[StepParams]] = {
    name.rstrip("_"): get_args(hint)[0]
    for name, hint in get_type_hints(StepRecord).items()
    if name != "inject"
}
"""Every step but `inject` by the name that a script gives it."""


class Mission(Scenario, frozen=True, kw_only=True):
    """Script of one flight, from the first frame to the verdict; adds to the keys of a scenario."""

    name: Annotated[str, msgspec.Meta(min_length=1, max_length=100)]
    about: str = ""
    """Purpose, in a sentence."""
    autopilots: tuple[FlavourName, ...] = ()
    """Autopilots that it fits and is flown on; empty: any, on `autopilot.flavour`."""
    companion: CompanionConfig | str = CompanionConfig()
    """The companion's configuration (configuration.md), or the file that it is in."""
    steps: Annotated[tuple[Union[StepRecord, StepWord], ...], msgspec.Meta(min_length=1)]  # noqa: UP007
    expectations: tuple[Expectation, ...] = ()

    @property
    def named_steps(self) -> tuple[tuple[str, Step], ...]:
        """Every step with its kind's name."""
        return tuple(_named(step) for step in self.steps)

    def misfit(self, flavour: str) -> str:
        """Return the reason why the script does not fit an autopilot; empty: it fits."""
        if not self.autopilots or flavour in self.autopilots:
            return ""
        return f"the script is for {' and '.join(self.autopilots)}, and this is {flavour}"

    @property
    def config(self) -> CompanionConfig:
        """The companion's configuration as the script gives it; TypeError: a file not read yet."""
        if isinstance(self.companion, str):
            raise TypeError(f"{self.companion} was not read; use load_mission")
        return self.companion

    @property
    def scenario(self) -> Scenario:
        """Scenario for the simulator."""
        return Scenario(**{name: getattr(self, name) for name in Scenario.__struct_fields__})


def _named(step: StepRecord | StepWord) -> tuple[str, Step]:
    if isinstance(step, str):
        return step, STEP_KINDS[step]()
    attribute = _one_given(step, "a step")
    name, value = attribute.rstrip("_"), getattr(step, attribute)
    return name, STEP_KINDS[name]() if value is None else value


@lru_cache(maxsize=1)
def numbers_by_name() -> dict[str, int]:
    """Return the message ids of the dialect, our own messages included."""
    return {str(kind.msgname): int(number) for number, kind in mavlink.mavlink_map.items()}
