"""The mission protocol for missions, fences and rally points: uploads and downloads.

Upload: MISSION_COUNT, then a request and an item for each number, then an ACK. The vehicle
requests, and repeats a request without an answer. On PX4 the new plan replaces the old one at the
ACK and not before: an error, a cancellation or a silence leaves the old one. ArduPilot cuts the old
mission at MISSION_COUNT and overwrites it item by item.

A repeated item is dropped silently; one further ahead triggers another request of the missing one.
Answering both with a request would double the traffic with every lost frame.

Download: the client requests the list, then each item, and sends MISSION_ACK at the end. PX4 waits
for it, even after a count of 0, and does nothing else for the partner until it arrives or five
seconds have passed; it sends the plan as of the request for the list. ArduPilot keeps no state and
sends any item to any client.

Source: MAVLink developer guide, "Mission Protocol"; PX4 1.15 and ArduCopter 4.5 as observed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.protocols.addressing import Newest, Outgoing, Partner, StatusTexts
from sim_link.autopilot.protocols.plan_items import (
    ALL_TYPES,
    ItemMessage,
    PlanItem,
    PlanResult,
    PlanStore,
    PlanType,
    ack,
    item_from,
    item_message,
    plan_type_of,
)
from sim_link.autopilot.protocols.plan_rules import (
    MAX_TRANSFERS,
    Download,
    PlanRules,
    Upload,
    plan_problem,
)

STORED_FRAMES = {
    mavlink.MAV_FRAME_GLOBAL_INT: mavlink.MAV_FRAME_GLOBAL,
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT: mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT,
}
"""Frame that ArduPilot reports for each stored one."""


class PlanUploads:
    """The uploads of all partners, each by itself."""

    def __init__(self, store: PlanStore, rules: PlanRules, texts: StatusTexts) -> None:
        self._store = store
        self._rules = rules
        self._texts = texts
        self._uploads: dict[Partner, Upload] = {}
        self._finished: Newest[Partner, tuple[PlanType, int]] = Newest(MAX_TRANSFERS)
        """The plan and last item of their last uploads, whose ACKs may have been lost."""

    def is_running(self, partner: Partner) -> bool:
        """Return True if a partner is uploading."""
        return partner in self._uploads

    def is_anyone_uploading(self, plan_type: PlanType, but: Partner | None = None) -> bool:
        """Return True if a plan is being uploaded by any partner other than `but`."""
        return any(
            upload.plan_type is plan_type and partner != but
            for partner, upload in self._uploads.items()
        )

    def begin(
        self, plan_type: PlanType, count: int, partner: Partner, now_s: float
    ) -> list[Outgoing]:
        """Answer a MISSION_COUNT; a running upload of the same partner is restarted."""
        refusal = self._refusal(plan_type, count, partner)
        if refusal is not None:
            return [ack(partner, refusal, plan_type)]
        self._uploads.pop(partner, None)
        if count == 0:
            self._store.replace(plan_type, ())
            return [ack(partner, PlanResult.ACCEPTED, plan_type)]
        if self._changes_at_once(plan_type):
            self._store.replace(plan_type, self._store.items(plan_type)[:count])
        upload = Upload(plan_type, count, now_s, now_s)
        self._uploads[partner] = upload
        return [self._ask(upload, partner, now_s)]

    def take(self, message: ItemMessage, partner: Partner, now_s: float) -> list[Outgoing]:
        """Answer an item."""
        upload = self._uploads.get(partner)
        if upload is None or upload.plan_type != message.mission_type:
            # An item that was not requested: our ACK was lost, or it is a mistake.
            last = (message.mission_type, message.seq)
            is_repeated = partner not in self._uploads and self._finished.get(partner) == last
            result = PlanResult.ACCEPTED if is_repeated else PlanResult.ERROR
            return [ack(partner, result, message.mission_type)]
        if message.seq != upload.expected:
            if self._rules.reports_wrong_number:
                return [ack(partner, PlanResult.INVALID_SEQUENCE, upload.plan_type)]
            if message.seq > upload.expected:
                return [self._ask(upload, partner, now_s)]
            return []
        item = self._checked(message, upload.plan_type)
        if isinstance(item, PlanResult):
            return self._fail(upload, partner, item, f"item {message.seq}: {_why(item)}")
        upload.items.append(self._as_stored(item))
        upload.active_s = now_s
        if message.current == 1:
            upload.current = message.seq
        if self._changes_at_once(upload.plan_type):
            self._store.patch(upload.plan_type, message.seq, upload.items[-1])
        if upload.expected < upload.count:
            return [self._ask(upload, partner, now_s)]
        return self._finish(upload, partner)

    def handle_timer(self, now_s: float) -> list[Outgoing]:
        """Repeat the request for a late item; abandon transfers that are silent for too long."""
        outgoing: list[Outgoing] = []
        for partner, upload in list(self._uploads.items()):
            if now_s >= upload.active_s + self._rules.timeout_s:
                text = f"item {upload.expected} did not arrive"
                outgoing += self._fail(upload, partner, PlanResult.CANCELLED, text)
            elif now_s >= upload.asked_s + self._rules.retry_s:
                outgoing.append(self._ask(upload, partner, now_s))
        return outgoing

    def drop(self, partner: Partner, plan_types: tuple[PlanType, ...] = tuple(PlanType)) -> None:
        """End a partner's upload, of some plans or any, without a message."""
        upload = self._uploads.get(partner)
        if upload is not None and upload.plan_type in plan_types:
            del self._uploads[partner]

    def _refusal(self, plan_type: PlanType, count: int, partner: Partner) -> PlanResult | None:
        if self._rules.is_one_at_a_time and self.is_anyone_uploading(plan_type, partner):
            return PlanResult.DENIED
        if count > self._rules.capacity[plan_type]:
            return PlanResult.NO_SPACE
        if partner not in self._uploads and len(self._uploads) >= MAX_TRANSFERS:
            return PlanResult.DENIED
        return None

    def _checked(self, message: ItemMessage, plan_type: PlanType) -> PlanItem | PlanResult:
        home = self._store.home_at(plan_type, message.seq)
        if home is not None:
            return home
        item = item_from(message)
        if isinstance(item, PlanResult):
            return item
        return self._rules.checks.problem_with(item, plan_type) or item

    def _finish(self, upload: Upload, partner: Partner) -> list[Outgoing]:
        if not self._changes_at_once(upload.plan_type):
            problem = plan_problem(upload.items, upload.plan_type)
            if problem is not None:
                return self._fail(upload, partner, problem, f"as a whole: {_why(problem)}")
        del self._uploads[partner]
        self._store.replace(upload.plan_type, upload.items, upload.current)
        self._finished[partner] = (upload.plan_type, upload.count - 1)
        return [ack(partner, PlanResult.ACCEPTED, upload.plan_type)]

    def _fail(
        self, upload: Upload, partner: Partner, result: PlanResult, why: str
    ) -> list[Outgoing]:
        del self._uploads[partner]
        text = f"{upload.plan_type.name.lower()} refused, {why}"
        return [*self._texts.warn(partner, text), ack(partner, result, upload.plan_type)]

    def _ask(self, upload: Upload, partner: Partner, now_s: float) -> Outgoing:
        upload.asked_s = now_s
        make = (
            mavlink.MAVLink_mission_request_message
            if self._rules.asks_in_old_form
            else mavlink.MAVLink_mission_request_int_message
        )
        request = make(*partner.ids, upload.expected, upload.plan_type)
        return Outgoing(request, partner.channel)

    def _changes_at_once(self, plan_type: PlanType) -> bool:
        return not self._rules.is_atomic and plan_type is PlanType.MISSION

    def _as_stored(self, item: PlanItem) -> PlanItem:
        if not self._rules.stores_less:
            return item
        first, second, third, fourth = (0.0 if math.isnan(each) else each for each in item.params)
        frame = STORED_FRAMES.get(item.frame, item.frame)
        return replace(item, params=(first, second, third, fourth), frame=frame)


def _why(result: PlanResult) -> str:
    return result.name.lower().replace("_", " ")


class PlanDownloads:
    """Downloads of all partners, kept separately."""

    def __init__(self, store: PlanStore, rules: PlanRules) -> None:
        self._store = store
        self._rules = rules
        self._downloads: dict[Partner, Download] = {}

    def is_running(self, partner: Partner) -> bool:
        """Return True if a partner still owes the ACK that ends its download."""
        return partner in self._downloads

    def begin(self, plan_type: PlanType, partner: Partner, now_s: float) -> list[Outgoing]:
        """Answer a MISSION_REQUEST_LIST."""
        if partner not in self._downloads and len(self._downloads) >= MAX_TRANSFERS:
            return [ack(partner, PlanResult.DENIED, plan_type)]
        items = self._store.items(plan_type)
        if self._rules.waits_for_ack:
            self._downloads[partner] = Download(plan_type, items, now_s)
        count = mavlink.MAVLink_mission_count_message(*partner.ids, len(items), plan_type)
        return [Outgoing(count, partner.channel)]

    def give(self, plan_type: PlanType, seq: int, partner: Partner, now_s: float) -> list[Outgoing]:
        """Answer a request for one item of either form by MISSION_ITEM_INT."""
        items = self._store.items(plan_type)
        if self._rules.waits_for_ack:
            download = self._downloads.get(partner)
            if download is None or download.plan_type is not plan_type:
                return [ack(partner, PlanResult.ERROR, plan_type)]
            download.active_s = now_s
            items = download.items
        if seq >= len(items):
            return [ack(partner, PlanResult.INVALID_SEQUENCE, plan_type)]
        message = item_message(
            self._store.home_at(plan_type, seq) or items[seq],
            seq,
            plan_type,
            partner.ids,
            is_current=plan_type is PlanType.MISSION and seq == self._store.current,
        )
        return [Outgoing(message, partner.channel)]

    def end(self, partner: Partner) -> None:
        """Handle the partner's ACK of any result."""
        self._downloads.pop(partner, None)

    def handle_timer(self, now_s: float) -> None:
        """Forget partners that never sent their ACK."""
        for partner, download in list(self._downloads.items()):
            if now_s >= download.active_s + self._rules.timeout_s:
                del self._downloads[partner]


GUIDED_ITEM = 2
"""MISSION_ITEM.current of an item that ArduPilot flies to at once, in GUIDED."""

OfOnePlan = (
    mavlink.MAVLink_mission_count_message
    | mavlink.MAVLink_mission_request_list_message
    | mavlink.MAVLink_mission_request_int_message
    | mavlink.MAVLink_mission_request_message
)
"""Messages that begin a transfer or request an item: never of all plans at once."""
FlyTo = Callable[[PlanItem], PlanResult]


class Plans:
    """Serves a vehicle's plans to all partners; `fly_to` obeys an item at once (ArduPilot)."""

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
        if isinstance(message, OfOnePlan):
            plan_type = plan_type_of(message.mission_type)
            if plan_type is None:
                return [ack(partner, PlanResult.UNSUPPORTED, message.mission_type)]
            return self._transfer(message, plan_type, partner, now_s)
        if isinstance(message, ItemMessage):
            return self._take_item(message, partner, now_s)
        match message:
            case mavlink.MAVLink_mission_ack_message():
                self._downloads.end(partner)
                if message.type == PlanResult.CANCELLED and self._rules.can_be_cancelled:
                    self._uploads.drop(partner)
            case mavlink.MAVLink_mission_clear_all_message():
                return [self._clear(message.mission_type, partner)]
            case mavlink.MAVLink_mission_set_current_message():
                if self.store.choose(message.seq):
                    return []  # `mission_progress` broadcasts the change
                return self._texts.warn(partner, f"there is no mission item {message.seq}")
            case (
                mavlink.MAVLink_mission_write_partial_list_message()
                | mavlink.MAVLink_mission_request_partial_list_message()
            ):
                return [ack(partner, PlanResult.UNSUPPORTED, message.mission_type)]
        return []

    def handle_timer(self, now_s: float) -> list[Outgoing]:
        """Repeat requests for late items; end transfers that have been silent for too long."""
        self._downloads.handle_timer(now_s)
        return self._uploads.handle_timer(now_s)

    def _transfer(
        self, message: OfOnePlan, plan_type: PlanType, partner: Partner, now_s: float
    ) -> list[Outgoing]:
        uploads, downloads = self._uploads, self._downloads
        match message:
            case mavlink.MAVLink_mission_count_message():
                if downloads.is_running(partner):
                    return [ack(partner, PlanResult.ERROR, plan_type)]
                return uploads.begin(plan_type, message.count, partner, now_s)
            case mavlink.MAVLink_mission_request_list_message():
                is_changing = not self._rules.is_atomic and uploads.is_anyone_uploading(plan_type)
                if is_changing or uploads.is_running(partner):
                    return [ack(partner, PlanResult.DENIED, plan_type)]
                return downloads.begin(plan_type, partner, now_s)
        return downloads.give(plan_type, message.seq, partner, now_s)

    def _clear(self, mission_type: int, partner: Partner) -> Outgoing:
        plan_type = plan_type_of(mission_type)
        if plan_type is None and mission_type != ALL_TYPES:
            return ack(partner, PlanResult.UNSUPPORTED, mission_type)
        cleared = tuple(PlanType) if plan_type is None else (plan_type,)
        self._uploads.drop(partner, cleared)
        for each in cleared:
            self.store.replace(each, ())
        return ack(partner, PlanResult.ACCEPTED, mission_type)

    def _take_item(self, message: ItemMessage, partner: Partner, now_s: float) -> list[Outgoing]:
        if message.current != GUIDED_ITEM or self._fly_to is None:
            return self._uploads.take(message, partner, now_s)
        item = item_from(message)
        if not isinstance(item, PlanResult):
            item = self._rules.checks.problem_with(item, PlanType.MISSION) or self._fly_to(item)
        return [ack(partner, item, message.mission_type)]
