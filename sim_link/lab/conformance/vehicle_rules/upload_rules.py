"""Uploads that go wrong, what plans are refused for, and geofences."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

from companion.mav.dialect import Message, mavlink
from sim_link.lab.conformance import protocol_clients as plans
from sim_link.lab.conformance.mavlink_oracle import (
    OBSERVED_ARDUPILOT,
    OBSERVED_PX4,
    PLAN_CANCELLED,
    PLAN_ERROR,
    PLAN_INVALID,
    PLAN_INVALID_SEQUENCE,
    PLAN_INVALID_X,
    PLAN_INVALID_Z,
    PLAN_NO_SPACE,
    PLAN_UNSUPPORTED,
    PLAN_UNSUPPORTED_FRAME,
)
from sim_link.lab.conformance.protocol_clients import (
    FENCE,
    MISSION,
    MissionItem,
    circle,
    places,
    polygon,
    prepare,
    require_stored,
    square,
    waypoint,
)
from sim_link.lab.conformance.rules import (
    ARDUPILOT_ONLY,
    CHANGES,
    FLIES,
    PX4_ONLY,
    NotApplicable,
    Role,
    RuleBook,
    require,
)
from sim_link.lab.conformance.vehicle_probe import ACK_S, NAN, VehicleProbe

upload_book = RuleBook(Role.VEHICLE, "uploads", CHANGES)
SERVICE = "MAVLink guide, Mission Protocol"
ParamValue = mavlink.MAVLink_param_value_message


@upload_book.rule(f"{SERVICE} (atomic)", flavours=PX4_ONLY)
def abandoned_upload_leaves_the_old_plan(probe: VehicleProbe) -> None:
    """An upload that stops half way times out and leaves the old mission."""
    wanted = prepare(probe)
    items = square(probe, 2)
    plans.begin_upload(probe, 2)
    probe.send(items[1].message(probe, 0, MISSION))
    probe.run(8.0)
    require_stored(probe, wanted)


@upload_book.rule(f"{SERVICE} (cancel: OPERATION_CANCELLED)", flavours=PX4_ONLY)
def cancelled_upload_leaves_the_old_plan(probe: VehicleProbe) -> None:
    """A client's ACK OPERATION_CANCELLED ends an upload and leaves the old mission."""
    wanted = prepare(probe)
    plans.begin_upload(probe, 2)
    probe.send(mavlink.MAVLink_mission_ack_message(*probe.target, PLAN_CANCELLED, MISSION))
    probe.run(0.5)
    probe.expect_none(plans.REQUESTS[1], what="still requested after the cancel")
    require_stored(probe, wanted)


@upload_book.rule(f"{SERVICE} (atomic)", flavours=PX4_ONLY)
def refused_upload_leaves_the_old_plan(probe: VehicleProbe) -> None:
    """An upload refused at its last item leaves the old mission."""
    wanted = prepare(probe)
    items = square(probe, 2)
    items[1] = replace(items[1], command=31_999)
    require(plans.upload(probe, items) != 0, "accepted")
    require_stored(probe, wanted)


@upload_book.rule(OBSERVED_ARDUPILOT, flavours=ARDUPILOT_ONLY)
def old_plan_is_cut_when_an_upload_begins(probe: VehicleProbe) -> None:
    """MISSION_COUNT cuts the old mission to the new length at once: uploads are not atomic."""
    prepare(probe, 4)
    plans.begin_upload(probe, 2)
    probe.run(10.0)
    require(len(plans.download(probe)) <= 2, "the old mission is still whole")


@upload_book.rule(OBSERVED_ARDUPILOT, flavours=ARDUPILOT_ONLY)
def cancel_of_a_client_is_ignored(probe: VehicleProbe) -> None:
    """A client's OPERATION_CANCELLED does not end an upload."""
    probe.get_ready()
    items = square(probe, 2)
    plans.begin_upload(probe, len(items))
    probe.send(mavlink.MAVLink_mission_ack_message(*probe.target, PLAN_CANCELLED, MISSION))
    mark = plans.send_item(probe, items[0], 0)
    plans.await_request(probe, mark, 1)
    probe.run(10.0)


@upload_book.rule(
    f"{SERVICE} (timeouts); {OBSERVED_PX4}; {OBSERVED_ARDUPILOT}",
    px4="every 250 ms, gives up after about 5 s",
    ardupilot="every second, gives up after 8 s with ACK 15 and a text",
)
def unanswered_request_is_repeated_then_given_up(probe: VehicleProbe) -> None:
    """A request without an answer is repeated, and given up in the end."""
    probe.get_ready()
    mark = plans.send_count(probe, 3, MISSION)
    probe.run(15.0)
    times = probe.times(plans.REQUESTS, mark)
    require(len(times) >= 3, f"requested {len(times)} times")
    gaps = [later - earlier for earlier, later in itertools.pairwise(times)]
    wanted_s, life_s = (0.25, (3.5, 6.5)) if probe.is_px4 else (1.0, (6.0, 9.5))
    for gap_s in gaps:
        require(0.7 * wanted_s < gap_s < 1.6 * wanted_s, f"repeated after {gap_s:.2f} s")
    lived_s = times[-1] - times[0]
    low_s, high_s = life_s
    require(low_s - wanted_s < lived_s < high_s, f"given up after {lived_s:.1f} s")
    if not probe.is_px4:
        acks = probe.heard(plans.Ack, mark)
        require(bool(acks) and acks[-1].type == PLAN_CANCELLED, "no ACK 15 at the end")


@upload_book.rule(
    SERVICE, px4="dropped, the expected item is requested again", ardupilot="ACK INVALID_SEQUENCE"
)
def item_out_of_order_is_not_taken(probe: VehicleProbe) -> None:
    """An item with another number than requested is not taken for it."""
    probe.get_ready()
    items = square(probe, 3)
    plans.begin_upload(probe, len(items))
    mark = plans.send_item(probe, items[2], 2)
    if not probe.is_px4:
        require(plans.await_ack(probe, mark) == PLAN_INVALID_SEQUENCE, "another ACK than 13")
        probe.run(10.0)
        return
    plans.await_request(probe, mark, 0)
    for number, item in enumerate(items):
        mark = plans.send_item(probe, item, number)
    require(plans.await_ack(probe, mark) == 0, "the upload cannot go on")


@upload_book.rule(f"{SERVICE}; {OBSERVED_PX4}", flavours=PX4_ONLY)
def item_without_an_upload_is_an_error(probe: VehicleProbe) -> None:
    """An item that nobody asked for is answered by an ACK with an error."""
    probe.get_ready()
    item = square(probe, 1)[0]
    result = plans.result_of(probe, item.message(probe, 0, MISSION))
    require(result != 0, f"ACK {result}")


@upload_book.rule(f"{OBSERVED_PX4}; the guide asks the client for that ACK", flavours=PX4_ONLY)
def unacknowledged_download_keeps_it_busy(probe: VehicleProbe) -> None:
    """Until a client acknowledges a download, or for 5 s, an upload is answered ERROR."""
    probe.get_ready()
    plans.clear(probe)
    probe.ask(mavlink.MAVLink_mission_request_list_message(*probe.target, MISSION), plans.Count)
    result = plans.result_of(probe, mission_count(probe, 1))
    require(result == PLAN_ERROR, f"ACK {result}")
    probe.run(6.0)
    plans.require_upload(probe, square(probe, 1))


@upload_book.rule(f"{SERVICE}; MAVSDK mission_impl.cpp", flavours=PX4_ONLY)
def items_that_mavsdk_sends_are_accepted(probe: VehicleProbe) -> None:
    """Waypoints in frame 6, DO_CHANGE_SPEED in MISSION frame and gimbal items are accepted."""
    probe.get_ready()
    place = square(probe, 1)[0]
    frame = mavlink.MAV_FRAME_MISSION
    speed = MissionItem(mavlink.MAV_CMD_DO_CHANGE_SPEED, frame, (1.0, 4.0, -1.0, NAN), 0, 0, NAN)
    gimbal = MissionItem(
        mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW, frame, (0.0, 0.0, NAN, NAN), 0, 0, 0.0
    )
    items = [replace(place, params=(0.0, 1.0, 0.0, NAN), current=1), speed, gimbal]
    plans.require_upload(probe, items)
    stored_items = plans.download(probe)
    require(len(stored_items) == 3, f"{len(stored_items)} items came back")
    require(stored_items[1].params[1] == 4.0, "the speed changed")


def mission_count(probe: VehicleProbe, count: int) -> Message:
    """MISSION_COUNT of a mission."""
    return mavlink.MAVLink_mission_count_message(*probe.target, count, MISSION)


plan_result_book = RuleBook(Role.VEHICLE, "plan_results", CHANGES)


MISSION_RESULT = f"{SERVICE}, MAV_MISSION_RESULT"


def require_refused(probe: VehicleProbe, item: MissionItem, *results: int) -> None:
    """A mission with one wrong item must be refused with one of the results."""
    result = plans.upload(probe, plans.with_home(probe, [item]))
    require(result in results, f"ACK {result}")


def waypoint_home(probe: VehicleProbe, height_m: float = 10.0) -> MissionItem:
    """A waypoint over home."""
    home = probe.home()
    return waypoint(home.latitude, home.longitude, height_m)


@plan_result_book.rule(MISSION_RESULT)
def unknown_frame_is_refused(probe: VehicleProbe) -> None:
    """A waypoint in a frame that is not known is refused as UNSUPPORTED_FRAME."""
    probe.get_ready()
    require_refused(probe, replace(waypoint_home(probe), frame=20), PLAN_UNSUPPORTED_FRAME)


@plan_result_book.rule(MISSION_RESULT)
def unknown_mission_command_is_refused(probe: VehicleProbe) -> None:
    """An item with a command that is not known is refused as UNSUPPORTED."""
    probe.get_ready()
    require_refused(probe, replace(waypoint_home(probe), command=31_999), PLAN_UNSUPPORTED)


@plan_result_book.rule(f"{MISSION_RESULT}; {OBSERVED_ARDUPILOT}")
def impossible_latitude_is_refused(probe: VehicleProbe) -> None:
    """A waypoint at 100 degrees north is refused as INVALID_PARAM5_X."""
    probe.get_ready()
    item = waypoint(1_000_000_000, 85_000_000, 10.0)
    require_refused(probe, item, PLAN_INVALID_X, PLAN_INVALID)


@plan_result_book.rule(f"{MISSION_RESULT}; {OBSERVED_ARDUPILOT}")
def impossible_altitude_is_refused(probe: VehicleProbe) -> None:
    """A waypoint at a NaN or endless altitude is refused as INVALID_PARAM7."""
    probe.get_ready()
    here = waypoint_home(probe)
    for height_m in (NAN, math.inf):
        require_refused(probe, replace(here, z=height_m), PLAN_INVALID_Z, PLAN_INVALID)


@plan_result_book.rule(f"{SERVICE}, MAV_MISSION_NO_SPACE")
def endless_mission_is_refused(probe: VehicleProbe) -> None:
    """More items than fit are refused as NO_SPACE, before any is requested."""
    probe.get_ready()
    result = plans.result_of(probe, mission_count(probe, 65_535))
    require(result == PLAN_NO_SPACE, f"ACK {result}")


fence_book = RuleBook(Role.VEHICLE, "fences", CHANGES)


def require_fence_kept(probe: VehicleProbe, wanted: list[MissionItem]) -> list[MissionItem]:
    """A fence that is uploaded must come back; its items as downloaded."""
    plans.require_upload(probe, wanted, FENCE)
    found = plans.download(probe, FENCE)
    plans.clear(probe, FENCE)
    require(places(found) == places(wanted), "the fence changed")
    return found


@fence_book.rule(f"{SERVICE}, Geofence")
def fences_survive(probe: VehicleProbe) -> None:
    """A polygon and a circle come back with their vertex count and radius."""
    probe.get_ready()
    wanted = polygon(probe) + circle(probe)
    found = require_fence_kept(probe, wanted)
    told = [item.params[0] for item in found]
    require(told == [4.0, 4.0, 4.0, 4.0, 500.0], f"param1 {told}")


@fence_book.rule(f"{SERVICE}, Geofence")
def exclusions_survive(probe: VehicleProbe) -> None:
    """Areas to stay out of come back as such, beside one to stay in."""
    probe.get_ready()
    (inside,) = circle(probe)
    hole = replace(
        inside,
        command=mavlink.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION,
        params=(10.0, 0.0, 0.0, 0.0),
        x=inside.x + 9_000,
    )
    vertex = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION
    zone = [
        replace(corner, command=vertex, y=corner.y + 90_000)
        for corner in polygon(probe, half=9_000)
    ]
    wanted = [inside, hole, *zone]
    require_fence_kept(probe, wanted)


@fence_book.rule(f"{SERVICE}, Geofence")
def broken_fence_is_refused(probe: VehicleProbe) -> None:
    """A polygon that tells more vertices than it has is refused, and the old fence stays."""
    probe.get_ready()
    plans.require_upload(probe, circle(probe), FENCE)
    result = plans.upload(probe, polygon(probe, told=7.0), FENCE)
    require(result != 0, "accepted")
    found = plans.download(probe, FENCE)
    plans.clear(probe, FENCE)
    require(len(found) == 1, f"{len(found)} items are left of the old fence")


@fence_book.rule(SERVICE)
def mission_item_in_a_fence_is_refused(probe: VehicleProbe) -> None:
    """A waypoint is no part of a fence: UNSUPPORTED, or another error."""
    probe.get_ready()
    require(plans.upload(probe, [waypoint_home(probe)], FENCE) != 0, "accepted")


@fence_book.rule(
    f"{SERVICE}, Geofence",
    effect=FLIES,
    px4="GF_ACTION",
    ardupilot="stays inside, destinations outside are refused",
)
def fence_is_kept(probe: VehicleProbe) -> None:
    """A vehicle sent out of its fence does not go on outwards."""
    probe.take_off()
    radius_m = 30.0
    plans.require_upload(probe, circle(probe, radius_m), FENCE)
    enable_fence(probe)
    probe.watch(mavlink.MAVLink_global_position_int_message, 0.1)
    here = probe.latest(mavlink.MAVLink_global_position_int_message)
    probe.reposition(mavlink.MAV_FRAME_GLOBAL, (here.lat + 9_000, here.lon, here.alt / 1e3))
    probe.run(25.0)
    home = probe.home()
    north, east, _ = probe.place()
    distance_m = math.dist((north, east), (home.x, home.y))
    plans.clear(probe, FENCE)
    disable_fence(probe)
    require(distance_m < radius_m + 15.0, f"{distance_m:.0f} m from the centre of {radius_m:g} m")


def enable_fence(probe: VehicleProbe) -> None:
    """Switch the fence on: GF_ACTION 2 (hold), or FENCE_ENABLE.

    Raises:
        NotApplicable: It cannot be switched on.
    """
    names = {True: (b"GF_ACTION", 2, 6), False: (b"FENCE_ENABLE", 1.0, 2)}
    name, value, kind = names[probe.is_px4]
    field = float(value) if not probe.is_px4 else 2.8e-45
    mark = probe.mark
    probe.send(mavlink.MAVLink_param_set_message(*probe.target, name, field, kind))

    def is_told() -> bool:
        """Whether the parameter's value came."""
        return any(m.param_id == name.decode() for m in probe.heard(ParamValue, mark))

    if not probe.run_until(is_told, ACK_S):
        raise NotApplicable(f"no parameter {name.decode()}")


def disable_fence(probe: VehicleProbe) -> None:
    """FENCE_ENABLE 0; PX4's goes with its fence."""
    if not probe.is_px4:
        probe.send(mavlink.MAVLink_param_set_message(*probe.target, b"FENCE_ENABLE", 0.0, 2))
