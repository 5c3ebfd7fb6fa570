"""Uploads to both autopilots."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.mav.dialect import mavlink
from sim_link.autopilot.ardupilot import firmware_profile as ardupilot_firmware
from sim_link.autopilot.protocols.plan_items import PlanChanged, PlanItem, PlanResult, PlanType
from sim_link.autopilot.protocols.plan_rules import PlanRules
from sim_link.autopilot.px4 import firmware_profile as px4_firmware
from tests.unit.sim_link.autopilot.protocols.plan_client import (
    FENCE,
    HOME,
    MISSION,
    NAN,
    RALLY,
    Client,
    OldRequest,
    Request,
    Text,
    asked,
    item_of,
    results,
    waypoint,
    waypoints,
)
from tests.unit.sim_link.autopilot.protocols.wire import (
    COMPANION,
    COMPANION_CHANNEL,
    STATION,
    STATION_CHANNEL,
    of_type,
)

PX4_RULES = px4_firmware.FIRMWARE.plans
ARDUPILOT_RULES = ardupilot_firmware.FIRMWARE.plans

BOTH = pytest.mark.parametrize("rules", [PX4_RULES, ARDUPILOT_RULES])
VERTEX = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION


def px4() -> Client:
    return Client(PX4_RULES)


def ardupilot() -> Client:
    return Client(ARDUPILOT_RULES, has_home=True)


def fence() -> list[PlanItem]:
    return [waypoint(n, command=VERTEX, params=(3.0, 0.0, 0.0, 0.0)) for n in range(3)]


def rally() -> list[PlanItem]:
    return [waypoint(command=mavlink.MAV_CMD_NAV_RALLY_POINT)]


# The exchange


@BOTH
@pytest.mark.parametrize("plan_type", [MISSION, FENCE, RALLY])
def test_a_plan_is_asked_for_item_by_item_and_acknowledged(
    rules: PlanRules, plan_type: PlanType
) -> None:
    client = Client(rules)
    plan = {MISSION: waypoints(3), FENCE: fence(), RALLY: rally()}[plan_type]
    assert client.upload(plan, plan_type) == PlanResult.ACCEPTED
    assert client.store.items(plan_type) == tuple(plan)
    assert PlanChanged(plan_type) in client.store.take_events()


def test_missions_fences_and_rally_points_are_stored_apart() -> None:
    client = px4()
    client.upload(waypoints(3))
    client.upload(fence(), FENCE)
    client.upload(rally(), RALLY)
    assert [len(client.store.items(kind)) for kind in (MISSION, FENCE, RALLY)] == [3, 3, 1]


def test_px4_asks_with_request_int_and_ardupilot_in_the_old_form() -> None:
    assert len(of_type(px4().count(2), Request)) == 1
    assert len(of_type(ardupilot().count(2), OldRequest)) == 1


def test_what_is_asked_and_said_goes_to_the_partner_alone() -> None:
    client = px4()
    outgoing = client.count(1) + client.item(0)
    assert {each.to for each in outgoing} == {STATION_CHANNEL}
    (request,) = of_type(outgoing, Request)
    assert (request.target_system, request.target_component) == (255, 190)


def test_the_old_float_items_are_understood() -> None:
    client = px4()
    client.count(1)
    old = mavlink.MAVLink_mission_item_message(
        1, 1, 0, 3, 16, 0, 1, 0.0, 0.0, 0.0, NAN, 47.5, 8.25, 20.0, MISSION
    )
    assert results(client.send(old)) == [PlanResult.ACCEPTED]
    (item,) = client.store.items(MISSION)
    assert (item.x, item.y, item.z) == (475_000_000, 82_500_000, 20.0)


@pytest.mark.parametrize(("x", "y", "result"), [(1e30, 8.0, 10), (47.0, -math.inf, 11)])
def test_old_float_coordinates_beyond_an_integer_are_refused(
    x: float, y: float, result: int
) -> None:
    client = px4()
    client.count(1)
    old = mavlink.MAVLink_mission_item_message(
        1, 1, 0, 3, 16, 0, 1, 0.0, 0.0, 0.0, 0.0, x, y, 20.0, MISSION
    )
    assert results(client.send(old)) == [result]


def test_a_mission_begins_with_the_item_marked_current() -> None:
    client = px4()
    client.count(2)
    client.item(0)
    client.item(1, current=1)
    assert client.store.current == 1


@BOTH
def test_a_count_of_zero_clears(rules: PlanRules) -> None:
    client = Client(rules)
    client.upload(waypoints(3))
    assert results(client.count(0)) == [PlanResult.ACCEPTED]
    assert client.store.items(MISSION) == ()


@BOTH
def test_more_than_there_is_room_for_is_no_space(rules: PlanRules) -> None:
    client = Client(rules)
    client.upload(waypoints(2))
    most = rules.capacity[MISSION]
    assert results(client.count(most + 1)) == [PlanResult.NO_SPACE]
    assert len(client.store.items(MISSION)) == 2
    assert asked(client.count(most)) == [0]


@pytest.mark.parametrize("plan_type", [3, 100, 255])
def test_a_type_that_does_not_exist_is_unsupported(plan_type: int) -> None:
    assert results(px4().count(2, plan_type)) == [PlanResult.UNSUPPORTED]


# Loss, repetition and order


def test_px4_drops_what_comes_too_early_and_asks_for_what_is_missing() -> None:
    client = px4()
    client.count(3)
    assert asked(client.item(2)) == [0]
    assert client.upload(waypoints(3)) == PlanResult.ACCEPTED
    assert client.store.items(MISSION) == tuple(waypoints(3))


def test_px4_drops_an_item_that_comes_twice_without_a_word() -> None:
    client = px4()
    client.count(3)
    client.item(0)
    assert client.item(0) == []
    assert asked(client.item(1)) == [2]


def test_ardupilot_tells_a_wrong_number_and_goes_on() -> None:
    client = ardupilot()
    client.count(3)
    assert results(client.item(2)) == [PlanResult.INVALID_SEQUENCE]
    assert asked(client.item(0)) == [1]


@pytest.mark.parametrize(
    ("client", "retry_s", "timeout_s"), [(px4(), 0.265, 5.0), (ardupilot(), 1.0, 8.0)]
)
def test_an_item_is_asked_for_again_until_the_upload_is_given_up(
    client: Client, retry_s: float, timeout_s: float
) -> None:
    client.count(2)
    heard = client.wait(timeout_s + 5.0)
    asked_s = [time_s for time_s, outgoing in heard if asked([outgoing])]
    ended_s = [time_s for time_s, outgoing in heard if results([outgoing])]
    assert asked_s[0] == pytest.approx(retry_s, abs=0.011)
    assert all(
        later - earlier == pytest.approx(retry_s, abs=0.011) for earlier, later in pairwise(asked_s)
    )
    assert ended_s == [pytest.approx(timeout_s, abs=0.011)]
    assert results([outgoing for _, outgoing in heard]) == [PlanResult.CANCELLED]
    assert len(of_type([outgoing for _, outgoing in heard], Text)) == 1
    assert client.plans.handle_timer(1e6) == []


def test_each_item_starts_the_waiting_again() -> None:
    client = px4()
    client.count(4)
    for seq in range(3):
        client.wait(4.9)
        client.item(seq)
    assert results(client.item(3)) == [PlanResult.ACCEPTED]


@settings(deadline=None)
@given(order=st.lists(st.integers(0, 5), max_size=60))
def test_whatever_the_order_only_the_whole_plan_is_ever_stored(order: list[int]) -> None:
    client, plan = px4(), waypoints(5)
    client.count(5)
    expected = 0
    for seq in order:
        if expected == 5:
            break
        client.item(seq, waypoint(seq))
        expected += seq == expected
        stored = client.store.items(MISSION)
        assert stored == (tuple(plan) if expected == 5 else ())


def test_a_client_that_missed_our_last_ack_gets_it_again() -> None:
    client = px4()
    client.upload(waypoints(3))
    assert results(client.item(2)) == [PlanResult.ACCEPTED]


@BOTH
@pytest.mark.parametrize("seq", [0, 1, 7])
def test_an_item_that_was_not_requested_is_an_error(rules: PlanRules, seq: int) -> None:
    client = Client(rules)
    assert results(client.item(seq)) == [PlanResult.ERROR]
    client.upload(waypoints(3))
    assert results(client.item(seq)) == [PlanResult.ERROR]


def test_an_item_of_another_plan_is_an_error_and_harms_nothing() -> None:
    client = px4()
    client.count(1)
    assert results(client.item(0, fence()[0], FENCE)) == [PlanResult.ERROR]
    assert results(client.item(0)) == [PlanResult.ACCEPTED]


def test_a_new_count_begins_again() -> None:
    client = px4()
    client.count(3)
    client.item(0)
    assert asked(client.count(2)) == [0]
    assert client.upload(waypoints(2, first=5)) == PlanResult.ACCEPTED
    assert client.store.items(MISSION) == tuple(waypoints(2, first=5))


# All or nothing, and ArduPilot's way


def interrupted(client: Client, how: str) -> None:
    """Upload one of three new items, then end it."""
    client.count(3)
    client.item(0, waypoint(20))
    match how:
        case "silence":
            client.wait(10.0)
        case "cancelled":
            client.end(PlanResult.CANCELLED)
        case "refused":
            client.item(1, waypoint(frame=10))


@pytest.mark.parametrize("how", ["silence", "cancelled", "refused"])
def test_an_upload_that_fails_leaves_px4_its_old_plan(how: str) -> None:
    client = px4()
    client.upload(waypoints(2))
    interrupted(client, how)
    assert client.store.items(MISSION) == tuple(waypoints(2))
    assert client.plans.handle_timer(1e6) == []


@pytest.mark.parametrize("how", ["silence", "refused"])
def test_an_upload_that_fails_leaves_ardupilot_a_mixture(how: str) -> None:
    client = ardupilot()
    client.upload(waypoints(6))
    interrupted(client, how)
    assert client.store.items(MISSION) == (HOME, *waypoints(6)[1:3])


def test_ardupilot_cuts_its_mission_at_the_count() -> None:
    client = ardupilot()
    client.upload(waypoints(6))
    client.count(2)
    assert len(client.store.items(MISSION)) == 2


def test_ardupilots_fence_changes_as_a_whole() -> None:
    client = ardupilot()
    client.upload(fence(), FENCE)
    client.count(1, FENCE)
    assert client.store.items(FENCE) == tuple(fence())


def test_ardupilot_does_not_let_a_client_cancel() -> None:
    client = ardupilot()
    client.count(2)
    client.end(PlanResult.CANCELLED)
    assert asked(client.item(0)) == [1]


def test_ardupilots_item_zero_is_home_whatever_is_sent_for_it() -> None:
    client = ardupilot()
    nonsense = waypoint(x=2**31 - 1, frame=77, z=NAN)
    assert client.upload([nonsense, *waypoints(2)]) == PlanResult.ACCEPTED
    assert client.store.items(MISSION) == (HOME, *waypoints(2))


# Several partners


def test_two_partners_upload_to_px4_beside_each_other_and_the_last_to_finish_wins() -> None:
    client = px4()
    client.count(2, partner=STATION)
    client.count(1, partner=COMPANION)
    client.item(0, waypoint(1), partner=STATION)
    assert results(client.item(0, waypoint(9), partner=COMPANION)) == [PlanResult.ACCEPTED]
    assert client.store.items(MISSION) == (waypoint(9),)
    assert results(client.item(1, waypoint(2), partner=STATION)) == [PlanResult.ACCEPTED]
    assert client.store.items(MISSION) == (waypoint(1), waypoint(2))


def test_a_partner_cannot_cancel_or_feed_anothers_upload() -> None:
    client = px4()
    client.count(2, partner=STATION)
    client.end(PlanResult.CANCELLED, partner=COMPANION)
    assert results(client.item(0, partner=COMPANION)) == [PlanResult.ERROR]
    assert asked(client.item(0, partner=STATION)) == [1]


def test_ardupilot_denies_a_second_uploader_and_lets_the_first_begin_again() -> None:
    client = ardupilot()
    client.count(2, partner=STATION)
    assert results(client.count(2, partner=COMPANION)) == [PlanResult.DENIED]
    assert asked(client.count(2, partner=STATION)) == [0]


def test_each_is_asked_on_its_own_channel() -> None:
    client = px4()
    client.count(2, partner=STATION)
    client.count(2, partner=COMPANION)
    again = [outgoing for _, outgoing in client.wait(0.3)]
    assert {each.to for each in again} == {STATION_CHANNEL, COMPANION_CHANNEL}


def test_strangers_cannot_fill_the_memory() -> None:
    client = px4()
    partners = [replace(STATION, system_id=n) for n in range(1, 200)]
    answers = [results(client.count(2, partner=partner)) for partner in partners]
    assert answers == [[]] * 16 + [[PlanResult.DENIED]] * 183
    client.wait(6.0)
    assert results(client.count(2, partner=COMPANION)) == []


# Refused plans


@BOTH
def test_a_bad_item_ends_the_upload_with_its_code_and_a_text(rules: PlanRules) -> None:
    client = Client(rules)
    client.count(2)
    outgoing = client.item(0, waypoint(frame=10))
    assert results(outgoing) == [PlanResult.UNSUPPORTED_FRAME]
    (text,) = of_type(outgoing, Text)
    assert text.text == "mission refused, item 0: unsupported frame"
    assert results(client.item(0)) == [PlanResult.ERROR]


def test_a_torn_fence_is_refused_at_its_end() -> None:
    client = px4()
    assert client.upload(fence()[:2] + vertex_of_four(), FENCE) == PlanResult.INVALID_PARAM1
    assert client.store.items(FENCE) == ()


def vertex_of_four() -> list[PlanItem]:
    return [waypoint(command=VERTEX, params=(4.0, 0.0, 0.0, 0.0))]


def test_messages_of_other_protocols_get_no_answer() -> None:
    client = px4()
    assert client.send(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)) == []


def test_the_wire_form_of_an_item_is_what_is_stored() -> None:
    client = px4()
    item = waypoint(1, params=(1.5, 2.5, NAN, NAN))
    client.count(1)
    client.send(item_of(item, 0))
    (stored,) = client.store.items(MISSION)
    assert stored.params[:2] == (1.5, 2.5)
    assert all(math.isnan(param) for param in stored.params[2:])
