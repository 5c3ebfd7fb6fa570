"""Uploads that go wrong: abandoned, cancelled, refused, out of order, unanswered."""

from __future__ import annotations

import itertools

from companion.mav.dialect import mavlink
from sim_link.conformance import plan_client as plans
from sim_link.conformance.plan_client import MISSION, PlanItem
from sim_link.conformance.plan_shapes import places, prepare, square, stored
from sim_link.conformance.results import (
    PLAN_CANCELLED,
    PLAN_ERROR,
    PLAN_INVALID_SEQUENCE,
)
from sim_link.conformance.rules import (
    ARDUPILOT_ONLY,
    PX4_ONLY,
    Effect,
    Role,
    RuleBook,
    require,
)
from sim_link.conformance.sources import OBSERVED_ARDUPILOT, OBSERVED_PX4
from sim_link.conformance.vehicle_probe import VehicleProbe
from sim_link.conformance.vehicle_station import NAN

book = RuleBook(Role.VEHICLE, "uploads")
SERVICE = "MAVLink guide, Mission Protocol"
CHANGES = Effect.CHANGES


@book.rule(f"{SERVICE} (atomic)", effect=CHANGES, flavours=PX4_ONLY)
def abandoned_upload_leaves_the_old_plan(probe: VehicleProbe) -> None:
    """An upload that stops half way times out and leaves the old mission."""
    wanted = prepare(probe)
    items = square(probe, 2)
    mark = plans.send_count(probe, 2, MISSION)
    plans.await_request(probe, mark, 0)
    probe.send(items[1].message(probe, 0, MISSION))
    probe.run(8.0)
    require(places(stored(probe)) == places(wanted), "the old mission is gone")


@book.rule(f"{SERVICE} (cancel: OPERATION_CANCELLED)", effect=CHANGES, flavours=PX4_ONLY)
def cancelled_upload_leaves_the_old_plan(probe: VehicleProbe) -> None:
    """A client's ACK OPERATION_CANCELLED ends an upload and leaves the old mission."""
    wanted = prepare(probe)
    mark = plans.send_count(probe, 2, MISSION)
    plans.await_request(probe, mark, 0)
    probe.send(mavlink.MAVLink_mission_ack_message(*probe.target, PLAN_CANCELLED, MISSION))
    probe.run(0.5)
    probe.expect_none(plans.REQUESTS[1], what="still requested after the cancel")
    require(places(stored(probe)) == places(wanted), "the old mission is gone")


@book.rule(f"{SERVICE} (atomic)", effect=CHANGES, flavours=PX4_ONLY)
def refused_upload_leaves_the_old_plan(probe: VehicleProbe) -> None:
    """An upload refused at its last item leaves the old mission."""
    wanted = prepare(probe)
    items = square(probe, 2)
    items[1] = plans.changed(items[1], command=31_999)
    require(plans.upload(probe, items) != 0, "accepted")
    require(places(stored(probe)) == places(wanted), "the old mission is gone")


@book.rule(OBSERVED_ARDUPILOT, effect=CHANGES, flavours=ARDUPILOT_ONLY)
def old_plan_is_cut_when_an_upload_begins(probe: VehicleProbe) -> None:
    """MISSION_COUNT cuts the old mission to the new length at once: uploads are not atomic."""
    prepare(probe, 4)
    mark = plans.send_count(probe, 2, MISSION)
    plans.await_request(probe, mark, 0)
    probe.run(10.0)
    require(len(plans.download(probe)) <= 2, "the old mission is still whole")


@book.rule(OBSERVED_ARDUPILOT, effect=CHANGES, flavours=ARDUPILOT_ONLY)
def cancel_of_a_client_is_ignored(probe: VehicleProbe) -> None:
    """A client's OPERATION_CANCELLED does not end an upload."""
    probe.get_ready()
    items = square(probe, 2)
    mark = plans.send_count(probe, len(items), MISSION)
    plans.await_request(probe, mark, 0)
    probe.send(mavlink.MAVLink_mission_ack_message(*probe.target, PLAN_CANCELLED, MISSION))
    mark = probe.mark
    probe.send(items[0].message(probe, 0, MISSION))
    plans.await_request(probe, mark, 1)
    probe.run(10.0)


@book.rule(
    f"{SERVICE} (timeouts); {OBSERVED_PX4}; {OBSERVED_ARDUPILOT}",
    effect=CHANGES,
    px4="every 250 ms, gives up after about 5 s",
    ardupilot="every second, gives up after 8 s with ACK 15 and a text",
)
def unanswered_request_is_repeated_then_given_up(probe: VehicleProbe) -> None:
    """A request without an answer is repeated, and given up in the end."""
    probe.get_ready()
    mark = plans.send_count(probe, 3, MISSION)
    probe.run(15.0)
    times = [e.time_s for e in probe.inbox[mark:] if isinstance(e.message, plans.REQUESTS)]
    require(len(times) >= 3, f"requested {len(times)} times")
    gaps = [later - earlier for earlier, later in itertools.pairwise(times)]
    wanted_s, life_s = (0.25, (3.5, 6.5)) if probe.is_px4 else (1.0, (6.0, 9.5))
    for gap_s in gaps:
        require(0.7 * wanted_s < gap_s < 1.6 * wanted_s, f"repeated after {gap_s:.2f} s")
    lived_s = times[-1] - times[0]
    low_s, high_s = life_s
    require(low_s - wanted_s < lived_s < high_s, f"given up after {lived_s:.1f} s")
    if not probe.is_px4:
        acks = [e.message for e in probe.inbox[mark:] if isinstance(e.message, plans.Ack)]
        require(bool(acks) and acks[-1].type == PLAN_CANCELLED, "no ACK 15 at the end")


@book.rule(
    SERVICE,
    effect=CHANGES,
    px4="dropped, the expected item is requested again",
    ardupilot="ACK INVALID_SEQUENCE",
)
def item_out_of_order_is_not_taken(probe: VehicleProbe) -> None:
    """An item with another number than requested is not taken for it."""
    probe.get_ready()
    items = square(probe, 3)
    mark = plans.send_count(probe, len(items), MISSION)
    plans.await_request(probe, mark, 0)
    mark = probe.mark
    probe.send(items[2].message(probe, 2, MISSION))
    if not probe.is_px4:
        require(plans.await_ack(probe, mark) == PLAN_INVALID_SEQUENCE, "another ACK than 13")
        probe.run(10.0)
        return
    plans.await_request(probe, mark, 0)
    for number, item in enumerate(items):
        mark = probe.mark
        probe.send(item.message(probe, number, MISSION))
    require(plans.await_ack(probe, mark) == 0, "the upload cannot go on")


@book.rule(f"{SERVICE}; {OBSERVED_PX4}", effect=CHANGES, flavours=PX4_ONLY)
def item_without_an_upload_is_an_error(probe: VehicleProbe) -> None:
    """An item that nobody asked for is answered by an ACK with an error."""
    probe.get_ready()
    item = square(probe, 1)[0]
    mark = probe.mark
    probe.send(item.message(probe, 0, MISSION))
    result = plans.await_ack(probe, mark)
    require(result != 0, f"ACK {result}")


@book.rule(
    f"{OBSERVED_PX4}; the guide asks the client for that ACK", effect=CHANGES, flavours=PX4_ONLY
)
def unacknowledged_download_keeps_it_busy(probe: VehicleProbe) -> None:
    """Until a client acknowledges a download, or for 5 s, an upload is answered ERROR."""
    probe.get_ready()
    plans.clear(probe)
    mark = probe.mark
    probe.send(mavlink.MAVLink_mission_request_list_message(*probe.target, MISSION))
    probe.expect(plans.Count, mark=mark)
    mark = plans.send_count(probe, 1, MISSION)
    result = plans.await_ack(probe, mark)
    require(result == PLAN_ERROR, f"ACK {result}")
    probe.run(6.0)
    plans.require_upload(probe, square(probe, 1))


@book.rule(f"{SERVICE}; MAVSDK mission_impl.cpp", effect=CHANGES, flavours=PX4_ONLY)
def items_that_mavsdk_sends_are_accepted(probe: VehicleProbe) -> None:
    """Waypoints in frame 6, DO_CHANGE_SPEED in MISSION frame and gimbal items are accepted."""
    probe.get_ready()
    place = square(probe, 1)[0]
    frame = mavlink.MAV_FRAME_MISSION
    speed = PlanItem(mavlink.MAV_CMD_DO_CHANGE_SPEED, frame, (1.0, 4.0, -1.0, NAN), 0, 0, NAN)
    gimbal = PlanItem(
        mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW, frame, (0.0, 0.0, NAN, NAN), 0, 0, 0.0
    )
    items = [plans.changed(place, params=(0.0, 1.0, 0.0, NAN), current=1), speed, gimbal]
    plans.require_upload(probe, items)
    stored_items = plans.download(probe)
    require(len(stored_items) == 3, f"{len(stored_items)} items came back")
    require(stored_items[1].params[1] == 4.0, "the speed changed")
