"""Downloads, and what else is asked of plans."""

from __future__ import annotations

import math

import pytest

from companion.mav.dialect import mavlink
from sim_link.autopilot.ardupilot import firmware_profile as ardupilot_firmware
from sim_link.autopilot.protocols.plan_items import CurrentChosen, PlanChanged, PlanItem, PlanResult
from sim_link.autopilot.protocols.plan_rules import PlanRules
from sim_link.autopilot.px4 import firmware_profile as px4_firmware
from tests.unit.sim_link.autopilot.protocols.plan_client import (
    FENCE,
    HOME,
    MISSION,
    NAN,
    RALLY,
    Client,
    Count,
    Item,
    OldRequest,
    Text,
    asked,
    item_of,
    results,
    waypoint,
    waypoints,
)
from tests.unit.sim_link.autopilot.protocols.wire import (
    COMPANION,
    STATION,
    STATION_CHANNEL,
    of_type,
)

PX4_RULES = px4_firmware.FIRMWARE.plans
ARDUPILOT_RULES = ardupilot_firmware.FIRMWARE.plans

BOTH = pytest.mark.parametrize("rules", [PX4_RULES, ARDUPILOT_RULES])


def px4(count: int = 0) -> Client:
    client = Client(PX4_RULES)
    if count:
        assert client.upload(waypoints(count)) == PlanResult.ACCEPTED
    return client


def ardupilot(count: int = 0) -> Client:
    client = Client(ARDUPILOT_RULES, has_home=True)
    if count:
        assert client.upload(waypoints(count)) == PlanResult.ACCEPTED
    return client


# The exchange


@BOTH
def test_what_was_uploaded_is_downloaded(rules: PlanRules) -> None:
    client = Client(rules)
    client.upload(waypoints(4))
    assert [(item.x, item.z) for item in client.download()] == [
        (item.x, item.z) for item in waypoints(4)
    ]


def test_a_nan_yaw_survives_on_px4_and_is_zero_on_ardupilot() -> None:
    item = waypoint(1, params=(0.0, 0.0, 0.0, NAN))
    for client, survives in ((px4(), True), (ardupilot(), False)):
        client.upload([waypoint(), item])
        assert math.isnan(client.download()[1].param4) is survives


@pytest.mark.parametrize(("frame", "kept", "stored"), [(5, 5, 0), (6, 6, 3), (3, 3, 3)])
def test_px4_keeps_a_frames_name_and_ardupilot_its_older_one(
    frame: int, kept: int, stored: int
) -> None:
    for client, expected in ((px4(), kept), (ardupilot(), stored)):
        client.upload([waypoint(), waypoint(1, frame=frame)])
        assert client.download()[1].frame == expected


def test_item_zero_is_home_on_ardupilot() -> None:
    first, *_ = ardupilot(3).download()
    assert (first.x, first.y, first.z, first.frame) == (HOME.x, HOME.y, HOME.z, HOME.frame)


@BOTH
def test_a_request_in_the_old_form_is_answered_with_an_int_item(rules: PlanRules) -> None:
    client = Client(rules)
    client.upload(waypoints(2))
    client.ask_list()
    (item,) = of_type(client.send(OldRequest(1, 1, 1, MISSION)), Item)
    assert item.seq == 1


def test_any_item_may_be_asked_for_again_and_in_any_order() -> None:
    client = px4(3)
    client.ask_list()
    order = [2, 0, 0, 1, 2]
    assert [of_type(client.ask(seq), Item)[0].seq for seq in order] == order


def test_the_item_that_is_next_is_marked() -> None:
    client = px4(3)
    client.store.current = 1
    assert [item.current for item in client.download()] == [0, 1, 0]


@BOTH
def test_an_item_beyond_the_last_is_an_invalid_sequence(rules: PlanRules) -> None:
    client = Client(rules)
    client.upload(waypoints(2))
    client.ask_list()
    assert results(client.ask(2)) == [PlanResult.INVALID_SEQUENCE]


def test_a_download_is_the_plan_as_it_was_when_it_was_asked_for() -> None:
    client = px4(3)
    client.ask_list(partner=STATION)
    client.upload(waypoints(1, first=9), partner=COMPANION)
    assert of_type(client.ask(2, partner=STATION), Item)[0].x == waypoint(2).x


def test_answers_go_to_the_partner_alone() -> None:
    client = px4(1)
    assert {each.to for each in client.ask_list() + client.ask(0)} == {STATION_CHANNEL}


@pytest.mark.parametrize("plan_type", [3, 255])
def test_a_type_that_does_not_exist_is_unsupported(plan_type: int) -> None:
    client = px4(1)
    assert results(client.ask_list(plan_type)) == [PlanResult.UNSUPPORTED]
    assert results(client.ask(0, plan_type)) == [PlanResult.UNSUPPORTED]


# The client's ACK


@pytest.mark.parametrize("count", [0, 2])
def test_px4_takes_no_upload_before_the_client_acknowledged_its_download(count: int) -> None:
    client = px4(count)
    assert of_type(client.ask_list(), Count)[0].count == count
    assert results(client.count(1)) == [PlanResult.ERROR]
    client.end()
    assert asked(client.count(1)) == [0]


def test_px4_waits_five_seconds_for_that_ack() -> None:
    client = px4()
    client.ask_list()
    client.wait(4.9)
    assert results(client.count(1)) == [PlanResult.ERROR]
    client.wait(0.2)
    assert asked(client.count(1)) == [0]


def test_another_partner_need_not_wait_for_it() -> None:
    client = px4()
    client.ask_list(partner=STATION)
    assert asked(client.count(1, partner=COMPANION)) == [0]


def test_px4_gives_no_item_outside_a_download() -> None:
    client = px4(2)
    assert results(client.ask(0)) == [PlanResult.ERROR]
    client.download()
    assert results(client.ask(0)) == [PlanResult.ERROR]


def test_px4_gives_no_item_of_another_plan_than_the_listed_one() -> None:
    client = px4(2)
    client.ask_list(FENCE)
    assert results(client.ask(0, MISSION)) == [PlanResult.ERROR]


def test_ardupilot_sends_any_item_at_any_time_and_needs_no_ack() -> None:
    client = ardupilot(3)
    assert of_type(client.ask(1), Item)[0].seq == 1
    client.ask_list()
    assert asked(client.count(2)) == [0]


def test_a_list_during_an_upload_is_denied() -> None:
    for client in (px4(1), ardupilot(1)):
        client.count(2)
        assert results(client.ask_list()) == [PlanResult.DENIED]


def test_anothers_upload_denies_a_list_on_ardupilot_only() -> None:
    for client, expected in ((px4(1), []), (ardupilot(1), [PlanResult.DENIED])):
        client.count(2, partner=COMPANION)
        assert results(client.ask_list(partner=STATION)) == expected


# Clearing


@BOTH
def test_clearing_one_plan_leaves_the_others(rules: PlanRules) -> None:
    client = Client(rules)
    client.upload(waypoints(2))
    client.upload([waypoint(command=mavlink.MAV_CMD_NAV_RALLY_POINT)], RALLY)
    client.store.take_events()
    clear = mavlink.MAVLink_mission_clear_all_message(1, 1, MISSION)
    assert results(client.send(clear)) == [PlanResult.ACCEPTED]
    assert client.store.items(MISSION) == ()
    assert len(client.store.items(RALLY)) == 1
    assert client.store.take_events() == [PlanChanged(MISSION)]


def test_type_255_clears_everything() -> None:
    client = px4(2)
    client.upload([waypoint(command=mavlink.MAV_CMD_NAV_RALLY_POINT)], RALLY)
    outgoing = client.send(mavlink.MAVLink_mission_clear_all_message(1, 1, 255))
    assert results(outgoing) == [PlanResult.ACCEPTED]
    assert [client.store.items(kind) for kind in (MISSION, FENCE, RALLY)] == [(), (), ()]


def test_an_unknown_type_clears_nothing() -> None:
    client = px4(2)
    outgoing = client.send(mavlink.MAVLink_mission_clear_all_message(1, 1, 9))
    assert results(outgoing) == [PlanResult.UNSUPPORTED]
    assert len(client.store.items(MISSION)) == 2


# The current item


def test_an_item_is_chosen_and_the_vehicle_informed() -> None:
    client = px4(3)
    client.store.take_events()
    assert client.send(mavlink.MAVLink_mission_set_current_message(1, 1, 2)) == []
    assert client.store.current == 2
    assert client.store.take_events() == [CurrentChosen(2)]


def test_an_item_that_does_not_exist_is_not_chosen_and_a_text_says_so() -> None:
    client = px4(3)
    outgoing = client.send(mavlink.MAVLink_mission_set_current_message(1, 1, 3))
    assert "no mission item 3" in of_type(outgoing, Text)[0].text
    assert client.store.current == 0


# What is not standard


@pytest.mark.parametrize(
    "message",
    [
        mavlink.MAVLink_mission_write_partial_list_message(1, 1, 0, 1, MISSION),
        mavlink.MAVLink_mission_request_partial_list_message(1, 1, 0, 1, MISSION),
    ],
)
@BOTH
def test_partial_lists_are_unsupported(rules: PlanRules, message: mavlink.MAVLink_message) -> None:
    assert results(Client(rules).send(message)) == [PlanResult.UNSUPPORTED]


def test_an_item_to_fly_to_at_once_goes_to_the_vehicle() -> None:
    flown: list[PlanItem] = []

    def fly_to(item: PlanItem) -> PlanResult:
        flown.append(item)
        return PlanResult.ACCEPTED

    client = Client(ARDUPILOT_RULES, fly_to=fly_to)
    outgoing = client.send(item_of(waypoint(4), 0, current=2))
    assert results(outgoing) == [PlanResult.ACCEPTED]
    assert flown == [waypoint(4)]
    bad = client.send(item_of(waypoint(4, z=NAN), 0, current=2))
    assert (results(bad), len(flown)) == ([PlanResult.INVALID_PARAM7], 1)


def test_strangers_cannot_fill_the_memory() -> None:
    client = px4(1)
    for system in range(1, 100):
        client.ask_list(partner=type(STATION)(STATION.channel, system, 1))
    assert results(client.ask_list()) == [PlanResult.DENIED]
    client.plans.handle_timer(100.0)
    assert results(client.ask_list()) == []


def test_each_request_keeps_a_slow_download_going() -> None:
    client = px4(3)
    client.ask_list()
    for seq in range(3):
        client.wait(4.0)
        assert of_type(client.ask(seq), Item)[0].seq == seq
