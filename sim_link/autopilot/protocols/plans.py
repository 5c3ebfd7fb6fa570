"""The mission protocol for missions, fences and rally points; see `plan_uploads`, `plan_downloads`.

Source: MAVLink developer guide, "Mission Protocol"; PX4 1.15 and ArduCopter 4.5 as observed.
"""

from __future__ import annotations

from collections.abc import Callable

from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.protocols.base import Channel, Outgoing, Partner
from sim_link.autopilot.protocols.plan_downloads import PlanDownloads
from sim_link.autopilot.protocols.plan_items import (
    ALL_TYPES,
    ItemMessage,
    PlanItem,
    PlanResult,
    PlanType,
    ack,
    item_from,
    plan_type_of,
)
from sim_link.autopilot.protocols.plan_store import PlanStore
from sim_link.autopilot.protocols.plan_transfers import PlanRules
from sim_link.autopilot.protocols.plan_uploads import PlanUploads
from sim_link.autopilot.protocols.statustext import StatusTexts

GUIDED_ITEM = 2
"""MISSION_ITEM.current of an item that ArduPilot flies to at once, in GUIDED."""

FlyTo = Callable[[PlanItem], PlanResult]


class Plans:
    """Serves one vehicle's plans to all partners; takes only messages that are for it.

    Args:
        store: What is kept; the vehicle reads it and takes its events.
        rules: Of the autopilot that is played.
        texts: Numbers the texts that say why something was refused.
        fly_to: Takes an item that ArduPilot is to fly to at once; answers with the ACK's result.
    """

    def __init__(
        self, store: PlanStore, rules: PlanRules, texts: StatusTexts, fly_to: FlyTo | None = None
    ) -> None:
        self.store = store
        self._rules = rules
        self._texts = texts
        self._fly_to = fly_to
        self._uploads = PlanUploads(store, rules, texts)
        self._downloads = PlanDownloads(store, rules)

    def handle(self, message: Message, partner: Partner, now_s: float) -> list[Outgoing]:
        """Answer a mission message; any other gets no answer."""
        match message:
            case mavlink.MAVLink_mission_count_message():
                return self._count(message, partner, now_s)
            case (
                mavlink.MAVLink_mission_item_int_message() | mavlink.MAVLink_mission_item_message()
            ):
                if message.current == GUIDED_ITEM and self._fly_to is not None:
                    return [self._guided(message, partner, self._fly_to)]
                return self._uploads.take(message, partner, now_s)
            case mavlink.MAVLink_mission_request_list_message():
                return self._list(message.mission_type, partner, now_s)
            case (
                mavlink.MAVLink_mission_request_int_message()
                | mavlink.MAVLink_mission_request_message()
            ):
                plan_type = plan_type_of(message.mission_type)
                if plan_type is None:
                    return [ack(partner, PlanResult.UNSUPPORTED, message.mission_type)]
                return self._downloads.give(plan_type, message.seq, partner, now_s)
            case mavlink.MAVLink_mission_ack_message():
                self._hear_ack(message, partner)
            case mavlink.MAVLink_mission_clear_all_message():
                return [self._clear(message.mission_type, partner)]
            case mavlink.MAVLink_mission_set_current_message():
                return self._set_current(message.seq, partner)
            case (
                mavlink.MAVLink_mission_write_partial_list_message()
                | mavlink.MAVLink_mission_request_partial_list_message()
            ):
                return [ack(partner, PlanResult.UNSUPPORTED, message.mission_type)]
        return []

    def handle_timer(self, now_s: float) -> list[Outgoing]:
        """Ask again for what is late; end what has been silent for too long."""
        self._downloads.handle_timer(now_s)
        return self._uploads.handle_timer(now_s)

    def next_timer_s(self) -> float:
        """When `handle_timer` has something to do; infinity if no transfer is running."""
        return min(self._uploads.next_timer_s(), self._downloads.next_timer_s())

    def forget(self, channel: Channel) -> None:
        """End what runs on a channel that is gone."""
        self._uploads.forget(channel)
        self._downloads.forget(channel)

    def _count(
        self, message: mavlink.MAVLink_mission_count_message, partner: Partner, now_s: float
    ) -> list[Outgoing]:
        plan_type = plan_type_of(message.mission_type)
        if plan_type is None:
            return [ack(partner, PlanResult.UNSUPPORTED, message.mission_type)]
        if self._downloads.is_running(partner):
            return [ack(partner, PlanResult.ERROR, plan_type)]
        return self._uploads.begin(plan_type, message.count, partner, now_s)

    def _list(self, mission_type: int, partner: Partner, now_s: float) -> list[Outgoing]:
        plan_type = plan_type_of(mission_type)
        if plan_type is None:
            return [ack(partner, PlanResult.UNSUPPORTED, mission_type)]
        is_changing = not self._rules.is_atomic and self._uploads.is_anyone_uploading(plan_type)
        if is_changing or self._uploads.is_running(partner):
            return [ack(partner, PlanResult.DENIED, plan_type)]
        return self._downloads.begin(plan_type, partner, now_s)

    def _hear_ack(self, message: mavlink.MAVLink_mission_ack_message, partner: Partner) -> None:
        self._downloads.end(partner)
        if message.type == PlanResult.CANCELLED and self._rules.can_be_cancelled:
            self._uploads.drop(partner)

    def _clear(self, mission_type: int, partner: Partner) -> Outgoing:
        plan_type = plan_type_of(mission_type)
        if plan_type is None and mission_type != ALL_TYPES:
            return ack(partner, PlanResult.UNSUPPORTED, mission_type)
        cleared = tuple(PlanType) if plan_type is None else (plan_type,)
        self._uploads.drop(partner, cleared)
        for each in cleared:
            self.store.replace(each, ())
        return ack(partner, PlanResult.ACCEPTED, mission_type)

    def _set_current(self, seq: int, partner: Partner) -> list[Outgoing]:
        """The change itself is told to everyone, by MISSION_CURRENT; see `mission_progress`."""
        if self.store.choose(seq):
            return []
        text = f"there is no mission item {seq}"
        messages = self._texts.messages(mavlink.MAV_SEVERITY_WARNING, text)
        return [Outgoing(message, partner.channel) for message in messages]

    def _guided(self, message: ItemMessage, partner: Partner, fly_to: FlyTo) -> Outgoing:
        item = item_from(message)
        if isinstance(item, PlanResult):
            return ack(partner, item, message.mission_type)
        problem = self._rules.checks.problem_with(item, PlanType.MISSION)
        result = fly_to(item) if problem is None else problem
        return ack(partner, result, message.mission_type)
