"""Plans: missions, fences and rally points; upload, download, cancel, timeouts, results."""

from __future__ import annotations

import math
from dataclasses import replace

from companion.mav.dialect import mavlink
from sim_link.lab.conformance import protocol_clients as plans
from sim_link.lab.conformance.mavlink_oracle import (
    OBSERVED_ARDUPILOT,
    OBSERVED_PX4,
    PLAN_ERROR,
    PLAN_INVALID,
    PLAN_INVALID_SEQUENCE,
    PLAN_UNSUPPORTED,
)
from sim_link.lab.conformance.protocol_clients import (
    ALL,
    FENCE,
    MISSION,
    RALLY,
    MissionItem,
    circle,
    places,
    prepare,
    rally,
    require_stored,
    square,
    stored,
    waypoint,
)
from sim_link.lab.conformance.rules import (
    ARDUPILOT_ONLY,
    CHANGES,
    FLIES,
    PX4_ONLY,
    Role,
    RuleBook,
    require,
)
from sim_link.lab.conformance.station import brief
from sim_link.lab.conformance.vehicle_probe import ACCEPTED, ACK_S, NAN, VehicleProbe

book = RuleBook(Role.VEHICLE, "missions", CHANGES)
SERVICE = "MAVLink guide, Mission Protocol"
MIN_LIFE_S = 0.5
Reached = mavlink.MAVLink_mission_item_reached_message
Current = mavlink.MAVLink_mission_current_message


@book.rule(SERVICE)
def uploaded_mission_can_be_downloaded(probe: VehicleProbe) -> None:
    """A mission that was uploaded comes back item by item."""
    wanted = prepare(probe)
    require_stored(probe, wanted)


@book.rule(SERVICE, ardupilot="frames 5 and 6 come back as 0 and 3, NaN yaw as 0")
def every_field_survives(probe: VehicleProbe) -> None:
    """Frame, parameters (a NaN yaw, too) and autocontinue survive a round trip."""
    probe.get_ready()
    home = probe.home()
    item = MissionItem(
        mavlink.MAV_CMD_NAV_WAYPOINT,
        mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
        (2.0, 1.5, 0.0, NAN),
        home.latitude + 900,
        home.longitude + 900,
        12.5,
    )
    plans.require_upload(probe, plans.with_home(probe, [item]))
    found = stored(probe)[0]
    require((found.x, found.y, found.z) == (item.x, item.y, item.z), "the place changed")
    require(found.params[0] == 2.0, f"param1 {found.params[0]}")
    if probe.is_px4:
        relative = (mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT, item.frame)
        require(found.frame in relative, f"frame {found.frame}")
        require(math.isnan(found.params[3]), f"yaw {found.params[3]}")
        require(found.params[1] == 1.5, f"param2 {found.params[1]}")
    else:
        require(found.frame == mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT, f"frame {found.frame}")
    require(found.autocontinue == 1, "autocontinue changed")


@book.rule(SERVICE)
def scaled_integers_in_plain_frames_are_accepted(probe: VehicleProbe) -> None:
    """MISSION_ITEM_INT in frames 0 and 3, as MAVProxy and PX4 clients send it, is accepted."""
    probe.get_ready()
    home = probe.home()
    amsl_m = home.altitude / 1e3 + 10.0
    items = [
        replace(waypoint(home.latitude + 900, home.longitude, 10.0), frame=3),
        replace(waypoint(home.latitude, home.longitude + 900, amsl_m), frame=0),
    ]
    plans.require_upload(probe, plans.with_home(probe, items))
    found = stored(probe)
    require([i.x for i in found] == [i.x for i in items], "the place changed")


@book.rule(SERVICE, flavours=ARDUPILOT_ONLY)
def item_zero_is_home(probe: VehicleProbe) -> None:
    """Item 0 is home, whatever is uploaded there."""
    probe.get_ready()
    home = probe.home()
    items = square(probe, 2)
    items[0] = waypoint(123_456_789, 98_765_432, 77.0)
    plans.require_upload(probe, items)
    first = plans.download(probe)[0]
    off = max(abs(first.x - home.latitude), abs(first.y - home.longitude))
    require(off < 100, f"item 0 is at {first.x}, {first.y}")


@book.rule(
    f"{SERVICE}; {OBSERVED_PX4}; {OBSERVED_ARDUPILOT}",
    px4="MISSION_REQUEST_INT",
    ardupilot="MISSION_REQUEST",
)
def items_are_requested_in_order(probe: VehicleProbe) -> None:
    """Items are requested one by one from 0, with the flavour's message, then acknowledged."""
    probe.get_ready()
    items = square(probe, 3)
    kind = plans.REQUESTS[1 if probe.is_px4 else 0]
    mark = plans.send_count(probe, len(items), MISSION)
    for number, item in enumerate(items):
        request = plans.await_request(probe, mark, number)
        require(isinstance(request, kind), f"requested by {request.get_type()}")
        mark = plans.send_item(probe, item, number)
    require(plans.await_ack(probe, mark) == 0, "not accepted")


@book.rule(SERVICE)
def legacy_request_gets_an_int_item(probe: VehicleProbe) -> None:
    """MISSION_REQUEST is answered by MISSION_ITEM_INT (or the legacy item)."""
    prepare(probe)
    plans.begin_download(probe)
    mark = probe.mark
    probe.send(mavlink.MAVLink_mission_request_message(*probe.target, 1, MISSION))
    kinds = (plans.Item, mavlink.MAVLink_mission_item_message)
    try:
        answer = probe.expect(kinds, mark=mark, within_s=ACK_S)
    finally:
        plans.finish_download(probe, MISSION)
    require(getattr(answer, "seq", None) == 1, brief(answer))


@book.rule(SERVICE)
def repeated_request_is_answered_again(probe: VehicleProbe) -> None:
    """An item requested twice, because it was lost, is sent twice."""
    prepare(probe)
    plans.begin_download(probe)
    first = plans.request_item(probe, 1, MISSION)
    second = plans.request_item(probe, 1, MISSION)
    plans.finish_download(probe, MISSION)
    require(places([first]) == places([second]), "two different items")


@book.rule(SERVICE)
def plans_are_stored_apart(probe: VehicleProbe) -> None:
    """A fence and rally points leave the mission as it is, and the other way round."""
    wanted = prepare(probe)
    plans.require_upload(probe, circle(probe), FENCE)
    plans.require_upload(probe, rally(probe), RALLY)
    require_stored(probe, wanted)
    require(len(plans.download(probe, FENCE)) == 1, "the fence changed")
    require(plans.clear(probe, MISSION) == 0, "not cleared")
    require(len(plans.download(probe, RALLY)) == 1, "the rally points went with the mission")
    plans.clear(probe, FENCE)
    plans.clear(probe, RALLY)


@book.rule(SERVICE)
def new_mission_replaces_the_old_one(probe: VehicleProbe) -> None:
    """A second upload replaces the first."""
    prepare(probe, 4)
    shorter = prepare(probe, 2)
    require_stored(probe, shorter)


@book.rule(SERVICE)
def empty_upload_clears(probe: VehicleProbe) -> None:
    """MISSION_COUNT 0 clears the mission and is acknowledged."""
    prepare(probe)
    count = mavlink.MAVLink_mission_count_message(*probe.target, 0, MISSION)
    require(plans.result_of(probe, count) == 0, "not acknowledged")
    require_stored(probe, [])


@book.rule(SERVICE)
def clear_all_clears_one_kind(probe: VehicleProbe) -> None:
    """MISSION_CLEAR_ALL clears its kind and is acknowledged, also when there is nothing."""
    prepare(probe)
    for _ in range(2):
        require(plans.clear(probe) == 0, "not acknowledged")
    require_stored(probe, [])


@book.rule(SERVICE, flavours=PX4_ONLY)
def clear_of_type_255_clears_everything(probe: VehicleProbe) -> None:
    """MISSION_CLEAR_ALL of type ALL clears missions, fences and rally points."""
    prepare(probe)
    plans.require_upload(probe, circle(probe), FENCE)
    plans.require_upload(probe, rally(probe), RALLY)
    require(plans.clear(probe, ALL) == 0, "not acknowledged")
    for kind in (MISSION, FENCE, RALLY):
        require(plans.download(probe, kind) == [], f"something of type {kind} is left")


@book.rule(SERVICE)
def empty_plan_has_count_zero(probe: VehicleProbe) -> None:
    """A download without a plan is answered by MISSION_COUNT 0 (1 with ArduPilot's home)."""
    probe.get_ready()
    plans.clear(probe)
    require_stored(probe, [])
    plans.clear(probe, FENCE)
    require(plans.download(probe, FENCE) == [], "the fence is not empty")


@book.rule(SERVICE)
def request_beyond_the_end_is_an_error(probe: VehicleProbe) -> None:
    """A request of an item that there is not is answered by an error, not by an item."""
    prepare(probe)
    plans.begin_download(probe)
    request = mavlink.MAVLink_mission_request_int_message(*probe.target, 500, MISSION)
    result = plans.result_of(probe, request)
    require(result in (PLAN_ERROR, PLAN_INVALID_SEQUENCE, PLAN_INVALID), f"ACK {result}")
    plans.finish_download(probe, MISSION)
    probe.run(MIN_LIFE_S)


@book.rule(
    f"{SERVICE} (partial lists are not standard)",
    ardupilot="ArduCopter takes a partial write; here it is asked to refuse it as the guide does",
)
def partial_lists_are_unsupported(probe: VehicleProbe) -> None:
    """MISSION_WRITE_PARTIAL_LIST and MISSION_REQUEST_PARTIAL_LIST are answered UNSUPPORTED."""
    for kind in (
        mavlink.MAVLink_mission_write_partial_list_message,
        mavlink.MAVLink_mission_request_partial_list_message,
    ):
        result = plans.result_of(probe, kind(*probe.target, 0, 1, MISSION))
        require(result == PLAN_UNSUPPORTED, f"{kind.msgname}: ACK {result}")


@book.rule(f"{SERVICE}, MAV_MISSION_TYPE_ALL")
def type_all_is_for_clearing_only(probe: VehicleProbe) -> None:
    """Upload and download of type ALL, or of a type that there is not, are UNSUPPORTED."""
    wanted = prepare(probe)
    for kind in (ALL, 77):
        for message in (
            mavlink.MAVLink_mission_count_message(*probe.target, 1, kind),
            mavlink.MAVLink_mission_request_list_message(*probe.target, kind),
        ):
            result = plans.result_of(probe, message)
            require(result == PLAN_UNSUPPORTED, f"{message.msgname} of type {kind}: ACK {result}")
    require_stored(probe, wanted)


@book.rule(f"{SERVICE}, Rally Points")
def rally_points_survive(probe: VehicleProbe) -> None:
    """A rally point comes back where it was put."""
    probe.get_ready()
    wanted = rally(probe)
    plans.require_upload(probe, wanted, RALLY)
    found = plans.download(probe, RALLY)
    plans.clear(probe, RALLY)
    require(places(found) == places(wanted), f"{places(found)}, not {places(wanted)}")


@book.rule("MAVLink guide, Routing")
def plans_for_another_system_are_ignored(probe: VehicleProbe) -> None:
    """MISSION_CLEAR_ALL and MISSION_COUNT for another system change nothing."""
    wanted = prepare(probe)
    mark = probe.mark
    probe.send(mavlink.MAVLink_mission_clear_all_message(77, 1, MISSION))
    probe.send(mavlink.MAVLink_mission_count_message(77, 1, 0, MISSION))
    probe.expect_none(plans.Ack, mark=mark, what="acknowledged")
    require_stored(probe, wanted)


@book.rule(f"{SERVICE} (MISSION_CURRENT)")
def current_item_can_be_set(probe: VehicleProbe) -> None:
    """DO_SET_MISSION_CURRENT moves MISSION_CURRENT; a number beyond the end is refused."""
    prepare(probe, 4)
    mark = probe.mark
    probe.require_result(ACCEPTED, mavlink.MAV_CMD_DO_SET_MISSION_CURRENT, 2.0, 0.0)
    probe.expect(Current, lambda m: m.seq == 2, mark=mark)
    result = probe.command(mavlink.MAV_CMD_DO_SET_MISSION_CURRENT, 90.0, 0.0)
    require(result != ACCEPTED, "90 is accepted")
    probe.ask(
        mavlink.MAVLink_mission_set_current_message(*probe.target, 1), Current, lambda m: m.seq == 1
    )


@book.rule(f"{SERVICE} (MISSION_CURRENT)", flavours=PX4_ONLY)
def mission_current_tells_total_and_state(probe: VehicleProbe) -> None:
    """MISSION_CURRENT tells the total and the state: none, then not started."""
    probe.get_ready()
    plans.clear(probe)
    probe.run(1.5)
    empty = probe.request(Current)
    require(empty.mission_state in (0, 1), f"without a mission: state {empty.mission_state}")
    prepare(probe)
    probe.run(1.5)
    told = probe.request(Current)
    require(told.total == 3, f"total {told.total}")
    require(told.mission_state in (0, 2), f"state {told.mission_state}")


@book.rule(f"{SERVICE}; MAVSDK mission progress", effect=FLIES)
def mission_is_flown_and_reported(probe: VehicleProbe) -> None:
    """A started mission reaches its items in order, told by MISSION_CURRENT and _ITEM_REACHED."""
    items = prepare(probe, 3)
    first = 0 if probe.is_px4 else 1
    probe.watch(Current, 0.5)
    probe.take_off()
    mark = probe.mark
    probe.require_mode("mission")
    probe.await_mode("mission")
    last = first + len(items) - 1
    probe.expect(Reached, lambda m: m.seq == last, within_s=90.0, mark=mark)
    reached = [m.seq for m in probe.heard(Reached, mark)]
    require(sorted(set(reached)) == list(range(first, last + 1)), f"reached {reached}")
    require(reached == sorted(reached), f"reached {reached}")
    probe.run(2.5)
    state = probe.latest(Current)
    require(state.mission_state in (0, 5), f"state {state.mission_state} at the end")
    plans.clear(probe)


@book.rule("MAVLink common, MAV_CMD_MISSION_START", effect=FLIES)
def mission_start_starts_it(probe: VehicleProbe) -> None:
    """MISSION_START in the air flies the mission."""
    prepare(probe, 2)
    probe.take_off()
    mark = probe.mark
    probe.require_result(ACCEPTED, mavlink.MAV_CMD_MISSION_START, 0.0, 0.0)
    probe.await_mode("mission")
    probe.expect(Reached, within_s=60.0, mark=mark)
    plans.clear(probe)
