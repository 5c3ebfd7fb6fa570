"""What is remembered of a transfer, and how the two autopilots differ in it.

Source: MAVLink developer guide, "Mission Protocol"; PX4 1.15 and ArduCopter 4.5 as observed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from companion.mav.dialect import mavlink
from sim_link.autopilot.protocols.plan_checks import PlanChecks
from sim_link.autopilot.protocols.plan_items import PlanItem, PlanType

MAX_TRANSFERS = 16
"""Uploads, and as many downloads, at a time; all end by themselves within seconds."""


@dataclass(frozen=True, slots=True)
class PlanRules:
    """How an autopilot transfers plans."""

    capacity: Mapping[PlanType, int]
    """Most items of each plan."""
    checks: PlanChecks
    retry_s: float
    """Silence after which an item is asked for again."""
    timeout_s: float
    """Silence after which a transfer is over."""
    is_atomic: bool = True
    """A mission changes as a whole, at the end of its upload; otherwise it is cut at
    MISSION_COUNT and overwritten item by item."""
    is_one_at_a_time: bool = False
    """A second partner may not upload the same plan meanwhile."""
    can_be_cancelled: bool = True
    """By the client's MISSION_ACK."""
    waits_for_ack: bool = True
    """A download lasts until the client's MISSION_ACK; items are given only during one."""
    tells_wrong_number: bool = False
    """An item out of order gets INVALID_SEQUENCE; otherwise it is dropped."""
    asks_in_old_form: bool = False
    """MISSION_REQUEST instead of MISSION_REQUEST_INT."""
    stores_less: bool = False
    """A NaN is given back as 0, and a frame by its older name."""


PX4_RULES = PlanRules(
    capacity={PlanType.MISSION: 2000, PlanType.FENCE: 64, PlanType.RALLY: 32},
    checks=PlanChecks(
        more_positions=frozenset({mavlink.MAV_CMD_NAV_LOITER_TO_ALT, mavlink.MAV_CMD_DO_SET_HOME}),
        more_others=frozenset({mavlink.MAV_CMD_SET_CAMERA_ZOOM, mavlink.MAV_CMD_SET_CAMERA_FOCUS}),
    ),
    retry_s=0.25,
    timeout_s=5.0,
)
ARDUPILOT_RULES = PlanRules(
    capacity={PlanType.MISSION: 650, PlanType.FENCE: 84, PlanType.RALLY: 50},
    checks=PlanChecks(
        zero_is_here=True,
        more_positions=frozenset(
            {mavlink.MAV_CMD_NAV_SPLINE_WAYPOINT, mavlink.MAV_CMD_DO_SET_HOME}
        ),
        more_others=frozenset(
            {
                mavlink.MAV_CMD_NAV_GUIDED_ENABLE,
                mavlink.MAV_CMD_DO_SET_RELAY,
                mavlink.MAV_CMD_DO_FENCE_ENABLE,
            }
        ),
    ),
    retry_s=1.0,
    timeout_s=8.0,
    is_atomic=False,
    is_one_at_a_time=True,
    can_be_cancelled=False,
    waits_for_ack=False,
    tells_wrong_number=True,
    asks_in_old_form=True,
    stores_less=True,
)


@dataclass(slots=True)
class Upload:
    """A plan on its way in."""

    plan_type: PlanType
    count: int
    active_s: float
    """When the last expected item came."""
    asked_s: float
    items: list[PlanItem] = field(default_factory=list)
    current: int = 0
    """The item that was marked as the one to begin with."""

    @property
    def expected(self) -> int:
        """The number of the item that is wanted next."""
        return len(self.items)


@dataclass(frozen=True, slots=True)
class Finished:
    """The last upload of a partner, whose ACK may have been lost."""

    plan_type: PlanType
    count: int


@dataclass(slots=True)
class Download:
    """A plan on its way out, as it was when it was asked for."""

    plan_type: PlanType
    items: tuple[PlanItem, ...]
    active_s: float
