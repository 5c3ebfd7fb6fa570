"""What a rule is: one sentence, where it is written, whom it binds, and a probe that tries it.

A probe returns when the rule holds, raises `Violation` when it does not, and `NotApplicable` when
the peer gives no occasion to tell. Rules are made by decorating their probe:

    book = RuleBook(Role.VEHICLE, "frames")

    @book.rule("MAVLink guide, Packet Serialization")
    def bad_crc_is_dropped(probe: VehicleProbe) -> None:
        '''A frame whose CRC is wrong has no effect.'''

The rule's id is `frames.bad_crc_is_dropped`, its statement the first line of the docstring.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any


class Role(Enum):
    """What the peer under test is."""

    VEHICLE = "vehicle"
    COMPANION = "companion"


class Flavour(Enum):
    """The autopilot: the one under test, or the one that a companion is shown."""

    PX4 = "px4"
    ARDUPILOT = "ardupilot"


BOTH = frozenset(Flavour)
PX4_ONLY = frozenset({Flavour.PX4})
ARDUPILOT_ONLY = frozenset({Flavour.ARDUPILOT})


class Effect(Enum):
    """The most that a probe does to the vehicle; each includes the ones before it."""

    ASKS = "asks"
    """Nothing that outlasts the connection: asks, listens, changes stream rates."""
    CHANGES = "changes"
    """Overwrites what is stored (plans, parameters, home) or the mode, disarmed."""
    FLIES = "flies"
    """Arms or may arm: propellers off, or a simulator."""

    def is_within(self, limit: Effect) -> bool:
        """Whether a run that allows `limit` may do this."""
        order = list(Effect)
        return order.index(self) <= order.index(limit)


class Violation(Exception):  # noqa: N818  what a rule finds is no error of ours
    """The peer broke the rule; the text says how."""


class NotApplicable(Exception):  # noqa: N818
    """The peer gives no occasion to try the rule; the text says why."""


Probe = Callable[[Any], None]
"""Takes a `VehicleProbe` or a `CompanionProbe`, by the rule's role."""


@dataclass(frozen=True, slots=True)
class Rule:
    """One rule."""

    rule_id: str
    """`group.what_must_hold`."""
    statement: str
    source: str
    role: Role
    effect: Effect
    flavours: frozenset[Flavour]
    deviations: Mapping[Flavour, str]
    """Where a real autopilot does something else, and what is asked of this flavour instead."""
    probe: Probe = field(repr=False)


class RuleBook:
    """Collects the rules of one group, in the order of their definition.

    Args:
        role: Whom they bind.
        group: First part of their ids.
    """

    def __init__(self, role: Role, group: str) -> None:
        self.rules: list[Rule] = []
        self._role = role
        self._group = group

    def rule(
        self,
        source: str,
        *,
        effect: Effect = Effect.ASKS,
        flavours: Iterable[Flavour] = BOTH,
        px4: str = "",
        ardupilot: str = "",
    ) -> Callable[[Probe], Probe]:
        """Make the decorated probe a rule.

        Args:
            source: The page, file or measurement that says so.
            effect: The most that the probe does to the vehicle.
            flavours: Whom it is asked of.
            px4: How PX4 deviates, if it does.
            ardupilot: How ArduPilot deviates, if it does.
        """
        told = {Flavour.PX4: px4, Flavour.ARDUPILOT: ardupilot}
        deviations = {flavour: text for flavour, text in told.items() if text}

        def register(probe: Probe) -> Probe:
            """Add the probe as a rule of its group."""
            name = probe.__name__
            statement = (probe.__doc__ or "").strip().partition("\n")[0]
            self.rules.append(
                Rule(
                    f"{self._group}.{name}",
                    statement,
                    source,
                    self._role,
                    effect,
                    frozenset(flavours),
                    deviations,
                    probe,
                )
            )
            return probe

        return register


def require(condition: bool, problem: str) -> None:
    """Raise `Violation` with `problem` unless the condition holds."""
    if not condition:
        raise Violation(problem)
