"""Plans on their way out: a list is asked for, then item by item, and at last the client says so.

PX4 waits for that MISSION_ACK, even after a count of 0, and does nothing else for the partner
until it comes or five seconds have passed; what it sends is the plan as it was when the list was
asked for. ArduPilot remembers nothing and gives any item to anyone.

Source: MAVLink developer guide, "Mission Protocol"; PX4 1.15 and ArduCopter 4.5 as observed.
"""

from __future__ import annotations

import math

from companion.mav.dialect import mavlink
from sim_link.autopilot.protocols.base import Channel, Outgoing, Partner
from sim_link.autopilot.protocols.plan_items import PlanResult, PlanType, ack, item_message
from sim_link.autopilot.protocols.plan_store import PlanStore
from sim_link.autopilot.protocols.plan_transfers import MAX_TRANSFERS, Download, PlanRules


class PlanDownloads:
    """The downloads of all partners, each by itself.

    Args:
        store: Where the plans are.
        rules: Of the autopilot that is played.
    """

    def __init__(self, store: PlanStore, rules: PlanRules) -> None:
        self._store = store
        self._rules = rules
        self._downloads: dict[Partner, Download] = {}

    def is_running(self, partner: Partner) -> bool:
        """Whether a partner still owes the ACK that ends its download."""
        return partner in self._downloads

    def begin(self, plan_type: PlanType, partner: Partner, now_s: float) -> list[Outgoing]:
        """Answer a MISSION_REQUEST_LIST."""
        if partner not in self._downloads and len(self._downloads) >= MAX_TRANSFERS:
            return [ack(partner, PlanResult.DENIED, plan_type)]
        items = self._store.items(plan_type)
        if self._rules.waits_for_ack:
            self._downloads[partner] = Download(plan_type, items, now_s)
        count = mavlink.MAVLink_mission_count_message(
            partner.system_id, partner.component_id, len(items), plan_type
        )
        return [Outgoing(count, partner.channel)]

    def give(self, plan_type: PlanType, seq: int, partner: Partner, now_s: float) -> list[Outgoing]:
        """Answer a request for one item, by MISSION_ITEM_INT whichever form it has."""
        items = self._store.items(plan_type)
        if self._rules.waits_for_ack:
            download = self._downloads.get(partner)
            if download is None or download.plan_type is not plan_type:
                return [ack(partner, PlanResult.ERROR, plan_type)]
            download.active_s = now_s
            items = download.items
        if seq >= len(items):
            return [ack(partner, PlanResult.INVALID_SEQUENCE, plan_type)]
        home = self._store.home_item() if self._store.is_home(plan_type, seq) else None
        message = item_message(
            home or items[seq],
            seq,
            plan_type,
            (partner.system_id, partner.component_id),
            is_current=plan_type is PlanType.MISSION and seq == self._store.current,
        )
        return [Outgoing(message, partner.channel)]

    def end(self, partner: Partner) -> None:
        """The partner sent its ACK, whatever it says."""
        self._downloads.pop(partner, None)

    def handle_timer(self, now_s: float) -> None:
        """Forget partners that never sent their ACK."""
        for partner, download in list(self._downloads.items()):
            if now_s >= download.active_s + self._rules.timeout_s:
                del self._downloads[partner]

    def next_timer_s(self) -> float:
        """When `handle_timer` has something to do; infinity if nothing is running."""
        return min(
            (each.active_s + self._rules.timeout_s for each in self._downloads.values()),
            default=math.inf,
        )

    def forget(self, channel: Channel) -> None:
        """End what runs on a channel that is gone."""
        for partner in [each for each in self._downloads if each.channel == channel]:
            del self._downloads[partner]
