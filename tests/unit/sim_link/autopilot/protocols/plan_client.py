"""A ground station's side of the mission protocol, on invented time."""

from __future__ import annotations

import math

from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.protocols.addressing import Outgoing, Partner, StatusTexts
from sim_link.autopilot.protocols.mission_protocol import FlyTo, Plans
from sim_link.autopilot.protocols.plan_items import PlanItem, PlanStore, PlanType
from sim_link.autopilot.protocols.plan_rules import PlanRules
from tests.unit.sim_link.autopilot.protocols.wire import STATION, of_type, received

Ack = mavlink.MAVLink_mission_ack_message
Count = mavlink.MAVLink_mission_count_message
Item = mavlink.MAVLink_mission_item_int_message
Request = mavlink.MAVLink_mission_request_int_message
OldRequest = mavlink.MAVLink_mission_request_message
Text = mavlink.MAVLink_statustext_message

MISSION, FENCE, RALLY = PlanType.MISSION, PlanType.FENCE, PlanType.RALLY
NAN = math.nan
LAT, LON = 473_977_420, 85_455_940
HOME = PlanItem(16, 0, (0.0, 0.0, 0.0, 0.0), LAT, LON, 488.0)


def waypoint(number: int = 0, **changes: object) -> PlanItem:
    """A waypoint north of home, its height the waypoint's number."""
    fields: dict[str, object] = {
        "command": mavlink.MAV_CMD_NAV_WAYPOINT,
        "frame": mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT,
        "params": (0.0, 0.0, 0.0, 0.0),
        "x": LAT + 1000 * number,
        "y": LON,
        "z": 10.0 + number,
    }
    return PlanItem(**{**fields, **changes})  # type: ignore[arg-type]


def waypoints(count: int, first: int = 0) -> list[PlanItem]:
    return [waypoint(first + number) for number in range(count)]


class Client:
    """Talks to one vehicle's plans; several partners may."""

    def __init__(
        self, rules: PlanRules, *, has_home: bool = False, fly_to: FlyTo | None = None
    ) -> None:
        self.store = PlanStore((lambda: HOME) if has_home else None)
        self.plans = Plans(self.store, rules, StatusTexts(), fly_to)
        self.now_s = 0.0

    def send(self, message: Message, partner: Partner = STATION) -> list[Outgoing]:
        return self.plans.handle(received(message, partner), partner, self.now_s)

    def wait(self, duration_s: float, step_s: float = 0.01) -> list[tuple[float, Outgoing]]:
        """Let time pass; return the messages until then, with their times."""
        heard = []
        end_s = self.now_s + duration_s
        while self.now_s < end_s - 1e-9:
            self.now_s = round(self.now_s + step_s, 6)
            heard += [(self.now_s, each) for each in self.plans.handle_timer(self.now_s)]
        return heard

    def count(
        self, count: int, plan_type: int = MISSION, partner: Partner = STATION
    ) -> list[Outgoing]:
        return self.send(Count(1, 1, count, plan_type), partner)

    def item(
        self,
        seq: int,
        item: PlanItem | None = None,
        plan_type: int = MISSION,
        partner: Partner = STATION,
        current: int = 0,
    ) -> list[Outgoing]:
        item = item or waypoint(seq)
        return self.send(item_of(item, seq, plan_type, current), partner)

    def upload(
        self, items: list[PlanItem], plan_type: int = MISSION, partner: Partner = STATION
    ) -> int:
        """Upload as asked; the result of the ACK."""
        outgoing = self.count(len(items), plan_type, partner)
        for _ in range(2 * len(items) + 1):
            acks = of_type(outgoing, Ack)
            if acks:
                assert acks[0].mission_type == plan_type
                return acks[0].type
            asked = of_type(outgoing, Request) + of_type(outgoing, OldRequest)
            assert len(asked) == 1
            seq = asked[0].seq
            outgoing = self.item(seq, items[seq], plan_type, partner)
        raise AssertionError("the upload does not end")

    def ask_list(self, plan_type: int = MISSION, partner: Partner = STATION) -> list[Outgoing]:
        return self.send(mavlink.MAVLink_mission_request_list_message(1, 1, plan_type), partner)

    def ask(self, seq: int, plan_type: int = MISSION, partner: Partner = STATION) -> list[Outgoing]:
        return self.send(Request(1, 1, seq, plan_type), partner)

    def end(self, result: int = 0, partner: Partner = STATION) -> None:
        assert self.send(Ack(1, 1, result, 0), partner) == []

    def download(self, plan_type: int = MISSION, partner: Partner = STATION) -> list[Item]:
        """Download and return all items, and send the ACK that a client owes."""
        (count,) = of_type(self.ask_list(plan_type, partner), Count)
        items = [
            item
            for seq in range(count.count)
            for item in of_type(self.ask(seq, plan_type, partner), Item)
        ]
        assert [item.seq for item in items] == list(range(count.count))
        self.end(partner=partner)
        return items


def item_of(item: PlanItem, seq: int, plan_type: int = MISSION, current: int = 0) -> Item:
    return Item(
        1,
        1,
        seq,
        item.frame,
        item.command,
        current,
        1,
        *item.params,
        item.x,
        item.y,
        item.z,
        plan_type,
    )


def results(outgoing: list[Outgoing]) -> list[int]:
    return [ack.type for ack in of_type(outgoing, Ack)]


def asked(outgoing: list[Outgoing]) -> list[int]:
    """Return the items that the vehicle requests, in either form."""
    return [request.seq for request in of_type(outgoing, Request) + of_type(outgoing, OldRequest)]
