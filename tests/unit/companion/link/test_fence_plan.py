from __future__ import annotations

import math
from itertools import pairwise

import pytest

from companion.geometry.geofence import GeoArea, GeoFence
from companion.guidance.events import AutopilotFenceRead
from companion.link.autopilot_fence import (
    LAST_REST_S,
    MAX_ITEMS,
    READ_AGAIN_S,
    RESEND_S,
    REST_S,
    TRIES,
    FenceDownload,
    Item,
    fence_of_items,
)
from companion.mav.codec import MAGIC_V1, MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.payloads import IdentifiedMissionCurrent

FENCE, MISSION = mavlink.MAV_MISSION_TYPE_FENCE, mavlink.MAV_MISSION_TYPE_MISSION
AUTOPILOT, OWN = (1, 1), (1, 191)
E7 = 10_000_000
IN, OUT, CIRCLE_IN, CIRCLE_OUT, RETURN = 5001, 5002, 5003, 5004, 5000
List = mavlink.MAVLink_mission_request_list_message
Request = mavlink.MAVLink_mission_request_int_message
Ack = mavlink.MAVLink_mission_ack_message


def item(
    seq: int,
    command: int = IN,
    param1: float = 3.0,
    latitude: float = 47.0,
    longitude: float = 8.0,
    *,
    frame: int = mavlink.MAV_FRAME_GLOBAL,
    plan: int = FENCE,
    target: tuple[int, int] = OWN,
) -> Item:
    x, y = round(latitude * E7), round(longitude * E7)
    return mavlink.MAVLink_mission_item_int_message(
        *target, seq, frame, command, 0, 1, param1, 0.0, 0.0, 0.0, x, y, 0.0, plan
    )


def count(items: int, plan: int = FENCE, target: tuple[int, int] = OWN) -> Message:
    return mavlink.MAVLink_mission_count_message(*target, items, plan)


def ack(result: int, plan: int = FENCE, target: tuple[int, int] = OWN) -> Message:
    return mavlink.MAVLink_mission_ack_message(*target, result, plan)


TRIANGLE = [item(0), item(1, longitude=8.01), item(2, latitude=47.01)]
CORNERS = ((47.0, 8.0), (47.0, 8.01), (47.01, 8.0))
GEO = GeoFence(GeoArea(CORNERS))


class Autopilot:
    """Answers every question, unless it loses it."""

    def __init__(self, items: list[Item]) -> None:
        self.items = items
        self.fetch = FenceDownload()
        self.now_s = 0.0
        self.asked: list[Message] = []
        self.deaf = 0
        """Questions that it does not hear, from now on."""

    def run(
        self, duration_s: float, *, is_wanted: bool = True, is_followed: bool = False
    ) -> list[AutopilotFenceRead]:
        result = []
        for _ in range(round(duration_s / 0.05)):
            self.now_s = round(self.now_s + 0.05, 6)
            given_up = self.fetch.check_silence(self.now_s)
            result += [] if given_up is None else [given_up]
            question = self.fetch.due(
                self.now_s, AUTOPILOT, is_wanted=is_wanted, is_followed=is_followed
            )
            if question is None:
                continue
            self.asked.append(question)
            if self.deaf > 0:
                self.deaf -= 1
                continue
            answer = self._answer(question)
            heard = None if answer is None else self.fetch.receive(answer, self.now_s, OWN)
            result += [] if heard is None else [heard]
        return result

    def _answer(self, question: Message) -> Message | None:
        if isinstance(question, List):
            return count(len(self.items))
        return self.items[question.seq] if isinstance(question, Request) else None


class TestTheTransfer:
    def test_a_fence_is_read_item_by_item_and_acknowledged(self) -> None:
        autopilot = Autopilot(TRIANGLE)
        assert autopilot.run(1.0, is_wanted=False) == []
        assert autopilot.asked == []
        (result,) = autopilot.run(1.0)
        assert result.fence == GEO
        assert result.problem is None
        kinds = [type(question) for question in autopilot.asked]
        assert kinds == [List, Request, Request, Request, Ack]
        assert [q.seq for q in autopilot.asked if isinstance(q, Request)] == [0, 1, 2]
        for question in autopilot.asked:
            assert isinstance(question, List | Request | Ack)
            assert (question.target_system, question.target_component) == AUTOPILOT
            assert question.mission_type == FENCE
        last = autopilot.asked[-1]
        assert isinstance(last, Ack)
        assert last.type == mavlink.MAV_MISSION_ACCEPTED

    def test_no_fence_is_acknowledged_as_well(self) -> None:
        autopilot = Autopilot([])
        assert autopilot.run(1.0) == [AutopilotFenceRead(0.05)]
        assert [type(question) for question in autopilot.asked] == [List, Ack]

    def test_what_is_lost_is_asked_for_again(self) -> None:
        autopilot = Autopilot(TRIANGLE)
        autopilot.deaf = TRIES - 1
        (result,) = autopilot.run(RESEND_S * TRIES + 1.0)
        assert result.fence == GEO
        autopilot = Autopilot(TRIANGLE)
        autopilot.run(0.1)
        autopilot.deaf = TRIES - 1
        (result,) = autopilot.run(RESEND_S * TRIES + 1.0)
        assert result.fence == GEO

    def test_silence_ends_and_is_tried_again_ever_more_rarely(self) -> None:
        autopilot = Autopilot(TRIANGLE)
        autopilot.deaf = 10_000
        result = autopilot.run(300.0)
        assert {event.problem for event in result} == {"no answer"}
        assert not result[0].is_unusable
        times_s = [event.time_s for event in result]
        assert times_s[0] == pytest.approx(TRIES * RESEND_S, abs=0.2)
        gaps_s = [b - a for a, b in pairwise(times_s)]
        assert gaps_s[0] == pytest.approx(REST_S + TRIES * RESEND_S, abs=0.2)
        assert gaps_s[1] == pytest.approx(2.0 * REST_S + TRIES * RESEND_S, abs=0.2)
        assert max(gaps_s) <= LAST_REST_S + TRIES * RESEND_S + 0.2

    def test_after_a_rest_it_is_read_again_only_if_it_is_wanted(self) -> None:
        autopilot = Autopilot(TRIANGLE)
        autopilot.run(1.0)
        asked = len(autopilot.asked)
        assert autopilot.run(2.0 * REST_S, is_wanted=False) == []
        assert len(autopilot.asked) == asked
        assert len(autopilot.run(REST_S)) == 1

    def test_a_refusal_is_tried_again_and_then_reported(self) -> None:
        fetch, result, now_s = FenceDownload(), None, 0.0
        while result is None and now_s < 10.0:
            now_s += 0.05
            result = fetch.check_silence(now_s)
            if fetch.due(now_s, AUTOPILOT, is_wanted=True) is not None:
                assert fetch.receive(ack(mavlink.MAV_MISSION_UNSUPPORTED), now_s, OWN) is None
        assert result is not None
        assert result.problem == "refused (unsupported)"
        assert not result.is_unusable

    def test_a_port_in_mavlink_1_is_asked_once_a_round_and_named(self) -> None:
        """ArduCopter 4.7-dev sends "Need mavlink2 for item transfer" to all, for each request."""
        unsupported = mavlink.MAV_MISSION_UNSUPPORTED
        body = bytes((3, 0, *AUTOPILOT, mavlink.MAVLINK_MSG_ID_MISSION_ACK, *OWN, unsupported))
        crc = mavlink.x25crc(body + bytes((Ack.crc_extra,))).crc
        (refused,) = MavCodec(9, 9).decode(bytes((MAGIC_V1,)) + body + crc.to_bytes(2, "little"))
        fetch, asked, problems = FenceDownload(), 0, []
        for step in range(round((REST_S + 5.0) / 0.05)):
            now_s = 0.05 * step
            result = fetch.check_silence(now_s)
            problems += [] if result is None else [result.problem]
            if fetch.due(now_s, AUTOPILOT, is_wanted=True) is not None:
                asked += 1
                fetch.receive(refused, now_s, OWN)
        assert asked == 2
        assert (
            problems
            == ["refused (its port speaks MAVLink 1, which has no fences: set it to MAVLink 2)"] * 2
        )

    def test_an_unknown_refusal_is_reported_by_its_number(self) -> None:
        fetch = FenceDownload()
        for step in range(200):
            fetch.due(0.05 * step, AUTOPILOT, is_wanted=True)
            fetch.receive(ack(99), 0.05 * step, OWN)
            result = fetch.check_silence(0.05 * step)
            if result is not None:
                break
        assert result is not None
        assert result.problem == "refused (result 99)"

    @pytest.mark.parametrize(
        "stray",
        [
            count(9, plan=MISSION),
            count(9, target=(255, 190)),
            count(9, target=(1, 190)),
            ack(0, plan=MISSION),
            mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3),
        ],
    )
    def test_answers_to_others_are_not_ours(self, stray: Message) -> None:
        autopilot = Autopilot(TRIANGLE)
        autopilot.deaf = 1
        autopilot.run(0.1)
        assert autopilot.fetch.receive(stray, autopilot.now_s, OWN) is None
        (result,) = autopilot.run(2.0)
        assert result.fence == GEO

    def test_a_broadcast_answer_is(self) -> None:
        fetch = FenceDownload()
        fetch.due(0.0, AUTOPILOT, is_wanted=True)
        assert fetch.receive(count(0, target=(0, 0)), 0.1, OWN) == AutopilotFenceRead(0.1)

    def test_items_out_of_turn_and_a_second_count_are_passed_over(self) -> None:
        fetch = FenceDownload()
        fetch.due(0.0, AUTOPILOT, is_wanted=True)
        assert fetch.receive(TRIANGLE[0], 0.0, OWN) is None  # before any count
        for message in (count(3), count(1), TRIANGLE[1], TRIANGLE[0], TRIANGLE[0], TRIANGLE[2]):
            assert fetch.receive(message, 0.1, OWN) is None
        assert fetch.receive(TRIANGLE[1], 0.1, OWN) is None
        result = fetch.receive(TRIANGLE[2], 0.2, OWN)
        assert result is not None
        assert result.fence == GEO

    def test_nothing_is_heard_that_was_not_asked_for(self) -> None:
        assert FenceDownload().receive(count(0), 0.0, OWN) is None

    def test_too_many_items_are_not_even_read(self) -> None:
        fetch = FenceDownload()
        fetch.due(0.0, AUTOPILOT, is_wanted=True)
        result = fetch.receive(count(MAX_ITEMS + 1), 0.1, OWN)
        assert result is not None
        assert result.problem == f"it has {MAX_ITEMS + 1} items, more than {MAX_ITEMS}"
        assert result.is_unusable
        assert isinstance(fetch.due(0.2, AUTOPILOT, is_wanted=False), Ack)

    def test_a_restart_begins_again(self) -> None:
        autopilot = Autopilot(TRIANGLE)
        autopilot.run(0.15)
        autopilot.fetch.restart()
        assert autopilot.fetch.check_silence(1e9) is None
        autopilot.asked.clear()
        (result,) = autopilot.run(1.0)
        assert isinstance(autopilot.asked[0], List)
        assert result.fence == GEO

    def test_a_fence_that_makes_none_is_reported_as_unusable(self) -> None:
        autopilot = Autopilot([item(0, command=16)])
        (result,) = autopilot.run(1.0)
        assert result.problem == "item 1: command 16 is no part of a fence"
        assert result.is_unusable


class TestItems:
    def test_polygons_circles_and_return_points(self) -> None:
        items = [
            item(0, RETURN),
            item(1, CIRCLE_OUT, 30.0),
            *TRIANGLE,
            *(item(k, OUT, 4.0, 47.001 + (k // 2) * 1e-3, 8.001 + (k % 2) * 1e-3) for k in (1, 0)),
            *(item(k, OUT, 4.0, 47.001 + (k // 2) * 1e-3, 8.001 + (k % 2) * 1e-3) for k in (2, 3)),
        ]
        fence = fence_of_items(items)
        assert fence is not None
        assert fence.inclusion == GEO.inclusion
        circle, polygon = fence.exclusions
        assert circle == GeoArea(((47.0, 8.0),), 30.0)
        assert len(polygon.corners_deg) == 4
        inside = fence_of_items([item(0, CIRCLE_IN, 300.0)])
        assert inside == GeoFence(GeoArea(((47.0, 8.0),), 300.0))

    @pytest.mark.parametrize("frame", [0, 3, 5, 6])
    def test_any_global_frame_will_do(self, frame: int) -> None:
        items = [item(k, latitude=c[0], longitude=c[1], frame=frame) for k, c in enumerate(CORNERS)]
        assert fence_of_items(items) == GEO

    @pytest.mark.parametrize("items", [[], [item(0, RETURN)]])
    def test_nothing_to_keep_to_is_no_fence(self, items: list[Item]) -> None:
        assert fence_of_items(items) is None

    @pytest.mark.parametrize(
        ("items", "problem"),
        [
            ([item(0, frame=1)], "item 1: frame 1 is not a global one"),
            ([item(0, 16)], "item 1: command 16 is no part of a fence"),
            ([item(0, param1=2.0)], "item 1: a polygon of 2 vertices"),
            ([item(0, param1=math.nan)], "item 1: a polygon of nan vertices"),
            ([item(0, param1=math.inf)], "item 1: a polygon of inf vertices"),
            ([item(0, param1=1e9)], "item 1: a polygon of 1e\\+09 vertices"),
            ([item(0, param1=3.5)] * 4, "item 1: the polygon of 3.5 vertices is incomplete"),
            (TRIANGLE[:2], "item 1: the polygon of 3 vertices is incomplete"),
            ([*TRIANGLE[:2], item(2, OUT)], "item 1: the polygon of 3 vertices is incomplete"),
            (
                [*TRIANGLE[:2], item(2, param1=4.0)],
                "item 1: the polygon of 3 vertices is incomplete",
            ),
            ([item(0, CIRCLE_IN, math.nan)], "item 1: a radius of nan m"),
            ([item(0, CIRCLE_OUT, 30.0)], "no inclusion area"),
            ([*TRIANGLE, item(3, CIRCLE_IN, 30.0)], "item 4: a second inclusion area"),
            ([item(0, CIRCLE_IN, 30.0, 0.0, 0.0)], "item 1: corner 1: 0/0"),
            ([item(0, CIRCLE_IN, 30.0, 214.7, 0.0)], "item 1: corner 1: 214.7/0 is not a latitude"),
        ],
    )
    def test_items_that_make_no_fence_are_refused_by_number(
        self, items: list[Item], problem: str
    ) -> None:
        with pytest.raises(ValueError, match=f"^{problem}"):
            fence_of_items(items)


def heard(message: Message) -> Message:
    """A message as it arrives, with its bytes."""
    codec = MavCodec(*AUTOPILOT)
    arrived = codec.decode_frame(codec.encode(message))
    assert arrived is not None
    return arrived


def current(fence_id: int) -> Message:
    return heard(IdentifiedMissionCurrent(0, 0xFFFF, 1, 2, (0, fence_id, 0)))


def parameter(name: str, value: float) -> Message:
    return heard(mavlink.MAVLink_param_value_message(name.encode(), value, 9, 1, 0))


class TestChanges:
    def test_another_id_is_a_change_and_the_first_one_is_none(self) -> None:
        fetch = FenceDownload()
        assert not fetch.notice(current(7), OWN)
        assert not fetch.notice(current(7), OWN)
        assert fetch.notice(current(8), OWN)
        assert fetch.notice(current(0), OWN)

    @pytest.mark.parametrize(
        ("message", "is_change"),
        [
            (ack(0, target=(255, 190)), True),
            (ack(0, plan=mavlink.MAV_MISSION_TYPE_ALL, target=(255, 190)), True),
            (ack(0, plan=MISSION, target=(255, 190)), False),
            (ack(1, target=(255, 190)), False),
            (ack(0), False),
        ],
    )
    def test_an_upload_by_another_station_is_a_change(
        self, message: Message, is_change: bool
    ) -> None:
        assert FenceDownload().notice(heard(message), OWN) is is_change

    def test_a_parameter_of_the_fence_is_one_where_it_was_another(self) -> None:
        fetch = FenceDownload()
        assert not fetch.notice(parameter("FENCE_RADIUS", 150.0), OWN)
        assert not fetch.notice(parameter("FENCE_RADIUS", 150.0), OWN)
        assert not fetch.notice(parameter("WPNAV_SPEED", 150.0), OWN)
        assert fetch.notice(parameter("FENCE_RADIUS", 40.0), OWN)

    def test_where_there_are_no_ids_it_is_read_again_and_again(self) -> None:
        autopilot = Autopilot(TRIANGLE)
        assert len(autopilot.run(1.0)) == 1
        again = autopilot.run(3.0 * READ_AGAIN_S, is_wanted=False, is_followed=True)
        assert [result.fence for result in again] == [GEO] * 3

    def test_where_there_are_ids_it_is_not(self) -> None:
        autopilot = Autopilot(TRIANGLE)
        autopilot.fetch.notice(current(7), OWN)
        autopilot.run(1.0)
        asked = len(autopilot.asked)
        autopilot.run(30.0, is_wanted=False, is_followed=True)
        assert len(autopilot.asked) == asked

    def test_silence_about_a_fence_that_may_have_changed_is_no_news(self) -> None:
        autopilot = Autopilot(TRIANGLE)
        autopilot.run(1.0)
        autopilot.deaf = 1000
        assert autopilot.run(60.0, is_wanted=False, is_followed=True) == []

    def test_a_change_begins_the_reading_again_at_once(self) -> None:
        autopilot = Autopilot(TRIANGLE)
        autopilot.run(1.0)
        autopilot.fetch.notice(current(7), OWN)
        assert autopilot.fetch.notice(current(8), OWN)
        (result,) = autopilot.run(1.0)
        assert result.fence == GEO
