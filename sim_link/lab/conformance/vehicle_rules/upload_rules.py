"""Failing uploads, reasons to refuse plans, and geofences."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

from companion.mav.dialect import mavlink
from sim_link.lab.conformance import mavlink_oracle as mav
from sim_link.lab.conformance.protocol_clients import REQUESTS, MissionItem, PlanClient
from sim_link.lab.conformance.rules import ARDUPILOT, CHANGES, FLIES, PX4, RuleBook, require
from sim_link.lab.conformance.vehicle_probe import VehicleProbe

SERVICE = "MAVLink guide, Mission Protocol"
MISSION_RESULT = f"{SERVICE}, MAV_MISSION_RESULT"


class UploadRules(PlanClient):
    """Rules of uploads that are interrupted, out of order or invalid."""

    book = RuleBook("uploads", CHANGES, begin=VehicleProbe.get_ready)

    def _cancel(self) -> None:
        self.send(mav.PlanAck(*self.target, mav.PLAN_CANCELLED, mav.MISSION))

    @book.rule(f"{SERVICE} (atomic)", flavours=PX4)
    def abandoned_upload_leaves_the_old_plan(self) -> None:
        """An upload that stops half way times out and leaves the old mission."""
        wanted = self.prepare()
        item = self.square(2)[1]
        self.begin_upload(2)
        self.send_item(item, 0)
        self.run(8.0)
        self.require_stored(wanted)

    @book.rule(f"{SERVICE} (cancel: OPERATION_CANCELLED)", flavours=PX4)
    def cancelled_upload_leaves_the_old_plan(self) -> None:
        """A client's ACK OPERATION_CANCELLED ends an upload and leaves the old mission."""
        wanted = self.prepare()
        self.begin_upload(2)
        self._cancel()
        self.run(0.5)
        self.expect_none(mav.ItemIntRequest, what="still requested after the cancel")
        self.require_stored(wanted)

    @book.rule(f"{SERVICE} (atomic)", flavours=PX4)
    def refused_upload_leaves_the_old_plan(self) -> None:
        """An upload refused at its last item leaves the old mission."""
        wanted = self.prepare()
        first, last = self.square(2)
        require(self.upload([first, replace(last, command=31_999)]) != 0, "accepted")
        self.require_stored(wanted)

    @book.rule(mav.OBSERVED_ARDUPILOT, flavours=ARDUPILOT)
    def old_plan_is_cut_when_an_upload_begins(self) -> None:
        """MISSION_COUNT cuts the old mission to the new length at once: uploads are not atomic."""
        self.prepare(4)
        self.begin_upload(2)
        self.run(10.0)
        require(len(self.download()) <= 2, "the old mission is still whole")

    @book.rule(mav.OBSERVED_ARDUPILOT, flavours=ARDUPILOT)
    def cancel_of_a_client_is_ignored(self) -> None:
        """A client's OPERATION_CANCELLED does not end an upload."""
        items = self.square(2)
        self.begin_upload(len(items))
        self._cancel()
        self.send_item(items[0], 0)
        self.await_request(1)
        self.run(10.0)

    @book.rule(f"{SERVICE} (timeouts); {mav.OBSERVED_PX4}; {mav.OBSERVED_ARDUPILOT}")
    def unanswered_request_is_repeated_then_given_up(self) -> None:
        """A request without an answer is repeated, and given up in the end."""
        self.send_count(3)
        self.run(15.0)
        times = self.times(REQUESTS, self.asked)
        require(len(times) >= 3, f"requested {len(times)} times")
        wanted_s, low_s, high_s = (0.25, 3.5, 6.5) if self.is_px4 else (1.0, 6.0, 9.5)
        for earlier, later in itertools.pairwise(times):
            gap_s = later - earlier
            require(0.7 * wanted_s < gap_s < 1.6 * wanted_s, f"repeated after {gap_s:.2f} s")
        lived_s = times[-1] - times[0]
        require(low_s - wanted_s < lived_s < high_s, f"given up after {lived_s:.1f} s")
        if not self.is_px4:
            results = [ack.type for ack in self.heard(mav.PlanAck, self.asked)]
            require(results[-1:] == [mav.PLAN_CANCELLED], "no ACK 15 at the end")

    @book.rule(SERVICE)
    def item_out_of_order_is_not_taken(self) -> None:
        """An item with another number than requested is not taken for it."""
        items = self.square(3)
        self.begin_upload(len(items))
        self.send_item(items[2], 2)
        if not self.is_px4:
            require(self.await_ack() == mav.PLAN_INVALID_SEQUENCE, "another ACK than 13")
            self.run(10.0)
            return
        self.await_request(0)
        for number, item in enumerate(items):
            self.send_item(item, number)
        require(self.await_ack() == 0, "the upload cannot go on")

    @book.rule(f"{SERVICE}; {mav.OBSERVED_PX4}", flavours=PX4)
    def item_without_an_upload_is_an_error(self) -> None:
        """An item that was not requested is answered by an ACK with an error."""
        self.send_item(self.square(1)[0], 0)
        result = self.await_ack()
        require(result != 0, f"ACK {result}")

    @book.rule(f"{mav.OBSERVED_PX4}; the guide asks the client for that ACK", flavours=PX4)
    def unacknowledged_download_keeps_it_busy(self) -> None:
        """Until a client acknowledges a download, or for 5 s, an upload is answered ERROR."""
        self.clear()
        self.begin_download()
        self.send_count(1)
        result = self.await_ack()
        require(result == mav.PLAN_ERROR, f"ACK {result}")
        self.run(6.0)
        self.require_upload(self.square(1))

    @book.rule(f"{SERVICE}; MAVSDK mission_impl.cpp", flavours=PX4)
    def items_that_mavsdk_sends_are_accepted(self) -> None:
        """Waypoints in frame 6, DO_CHANGE_SPEED in MISSION frame and gimbal items are accepted."""
        waypoint = replace(self.square(1)[0], params=(0.0, 1.0, 0.0, mav.NAN), current=1)
        frame, gimbal = mavlink.MAV_FRAME_MISSION, mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW
        items = [
            waypoint,
            MissionItem(
                mavlink.MAV_CMD_DO_CHANGE_SPEED, frame, (1.0, 4.0, -1.0, mav.NAN), z=mav.NAN
            ),
            MissionItem(gimbal, frame, (0.0, 0.0, mav.NAN, mav.NAN)),
        ]
        self.require_upload(items)
        found = self.download()
        require(len(found) == 3, f"{len(found)} items came back")
        require(found[1].params[1] == 4.0, "the speed changed")


class PlanResultRules(PlanClient):
    """Refusals of plans."""

    book = RuleBook("plan_results", CHANGES, begin=VehicleProbe.get_ready)

    def _require_refused(self, changes: dict[str, Any], *results: int) -> None:
        """A mission with one changed waypoint over home must be refused with one of the results."""
        result = self.upload(self.with_home([replace(self.waypoint_home(), **changes)]))
        require(result in results, f"ACK {result}")

    @book.rule(MISSION_RESULT)
    def unknown_frame_is_refused(self) -> None:
        """A waypoint in a frame that is not known is refused as UNSUPPORTED_FRAME."""
        self._require_refused({"frame": 20}, mav.PLAN_UNSUPPORTED_FRAME)

    @book.rule(MISSION_RESULT)
    def unknown_mission_command_is_refused(self) -> None:
        """An item with a command that is not known is refused as UNSUPPORTED."""
        self._require_refused({"command": 31_999}, mav.PLAN_UNSUPPORTED)

    @book.rule(f"{MISSION_RESULT}; {mav.OBSERVED_ARDUPILOT}", harms=True)
    def impossible_latitude_is_refused(self) -> None:
        """A waypoint at 100 degrees north is refused as INVALID_PARAM5_X."""
        self._require_refused(
            {"x": 1_000_000_000, "y": 85_000_000}, mav.PLAN_INVALID_X, mav.PLAN_INVALID
        )

    @book.rule(f"{MISSION_RESULT}; {mav.OBSERVED_ARDUPILOT}", harms=True)
    def impossible_altitude_is_refused(self) -> None:
        """A waypoint at a NaN or endless altitude is refused as INVALID_PARAM7."""
        for height_m in (mav.NAN, math.inf):
            self._require_refused({"z": height_m}, mav.PLAN_INVALID_Z, mav.PLAN_INVALID)

    @book.rule(f"{SERVICE}, MAV_MISSION_NO_SPACE")
    def endless_mission_is_refused(self) -> None:
        """More items than fit are refused as NO_SPACE, before any is requested."""
        self.send_count(65_535)
        result = self.await_ack()
        require(result == mav.PLAN_NO_SPACE, f"ACK {result}")


class FenceRules(PlanClient):
    """Geofences."""

    book = RuleBook("fences", CHANGES, begin=VehicleProbe.get_ready)

    def _require_fence_kept(self, wanted: list[MissionItem]) -> list[MissionItem]:
        """Require that an uploaded fence can be downloaded; return its items."""
        self.require_upload(wanted, mav.FENCE)
        found = self.download(mav.FENCE)
        self.clear(mav.FENCE)
        stored, uploaded = ([i.lasting_fields for i in items] for items in (found, wanted))
        require(stored == uploaded, "the fence changed")
        return found

    @book.rule(f"{SERVICE}, Geofence")
    def fences_survive(self) -> None:
        """A polygon and a circle are downloaded with their vertex count and radius."""
        found = self._require_fence_kept(self.polygon() + self.circle())
        params = [item.params[0] for item in found]
        require(params == [4.0, 4.0, 4.0, 4.0, 500.0], f"param1 {params}")

    @book.rule(f"{SERVICE}, Geofence")
    def exclusions_survive(self) -> None:
        """Exclusions are downloaded as such, next to an inclusion."""
        (inside,) = self.circle()
        (hole,) = self.circle(10.0)
        circle = mavlink.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION
        vertex = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION
        zone = self.polygon(half=9_000)
        wanted = [inside, replace(hole, command=circle, x=hole.x + 9_000)]
        wanted += [replace(corner, command=vertex, y=corner.y + 90_000) for corner in zone]
        self._require_fence_kept(wanted)

    @book.rule(f"{SERVICE}, Geofence")
    def broken_fence_is_refused(self) -> None:
        """A polygon that states more vertices than it has is refused, and the old fence stays."""
        self.require_upload(self.circle(), mav.FENCE)
        require(self.upload(self.polygon(stated=7.0), mav.FENCE) != 0, "accepted")
        found = self.download(mav.FENCE)
        self.clear(mav.FENCE)
        require(len(found) == 1, f"{len(found)} items are left of the old fence")

    @book.rule(SERVICE)
    def mission_item_in_a_fence_is_refused(self) -> None:
        """A waypoint cannot be part of a fence: UNSUPPORTED, or another error."""
        require(self.upload([self.waypoint_home()], mav.FENCE) != 0, "accepted")

    @book.rule(f"{SERVICE}, Geofence", effect=FLIES)
    def fence_is_kept(self) -> None:
        """A vehicle sent out of its fence does not continue outwards."""
        self.take_off()
        radius_m = 30.0
        self.require_upload(self.circle(radius_m), mav.FENCE)
        self.enable_fence()
        self.watch(mav.GlobalPosition, 0.1)
        here = self.latest(mav.GlobalPosition)
        self.reposition(mavlink.MAV_FRAME_GLOBAL, (here.lat + 9_000, here.lon, here.alt / 1e3))
        self.run(25.0)
        home = self.home()
        distance_m = math.dist(self.position()[:2], (home.x, home.y))
        problem = f"{distance_m:.0f} m from the centre of {radius_m:g} m"
        require(distance_m < radius_m + 15.0, problem)
