"""Missions that go right: upload, download, clearing, rally points, and how they are flown."""

from __future__ import annotations

import math
from dataclasses import replace

from companion.mav.dialect import mavlink
from sim_link.lab.conformance import mavlink_oracle as mav
from sim_link.lab.conformance.protocol_clients import REQUESTS, PlanClient, waypoint
from sim_link.lab.conformance.rules import ARDUPILOT, CHANGES, FLIES, PX4, RuleBook, require
from sim_link.lab.conformance.station import brief
from sim_link.lab.conformance.vehicle_probe import ACK_S, VehicleProbe

SERVICE = "MAVLink guide, Mission Protocol"
SET_CURRENT = mavlink.MAV_CMD_DO_SET_MISSION_CURRENT


class MissionRules(PlanClient):
    """Rules of complete uploads and downloads of missions."""

    book = RuleBook("missions", CHANGES, begin=VehicleProbe.get_ready)

    @book.rule(SERVICE)
    def uploaded_mission_can_be_downloaded(self) -> None:
        """An uploaded mission can be downloaded item by item."""
        self.require_stored(self.prepare())

    @book.rule(SERVICE)
    def every_field_survives(self) -> None:
        """Frame, parameters (a NaN yaw, too) and autocontinue survive a round trip."""
        home = self.home()
        item = waypoint(home.latitude + 900, home.longitude + 900, 12.5)
        item = replace(item, params=(2.0, 1.5, 0.0, mav.NAN))
        self.require_upload(self.with_home([item]))
        found = self.stored()[0]
        require((found.x, found.y, found.z) == (item.x, item.y, item.z), "the position changed")
        require(found.params[0] == 2.0, f"param1 {found.params[0]}")
        relative = [mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT]
        if self.is_px4:
            relative.append(item.frame)
            require(math.isnan(found.params[3]), f"yaw {found.params[3]}")
            require(found.params[1] == 1.5, f"param2 {found.params[1]}")
        require(found.frame in relative, f"frame {found.frame}")
        require(found.autocontinue == 1, "autocontinue changed")

    @book.rule(SERVICE)
    def scaled_integers_in_plain_frames_are_accepted(self) -> None:
        """MISSION_ITEM_INT in frames 0 and 3, as MAVProxy and PX4 clients send it, is accepted."""
        home = self.home()
        amsl_m = home.altitude / 1e3 + 10.0
        items = [
            replace(waypoint(home.latitude + 900, home.longitude, 10.0), frame=3),
            replace(waypoint(home.latitude, home.longitude + 900, amsl_m), frame=0),
        ]
        self.require_upload(self.with_home(items))
        require([i.x for i in self.stored()] == [i.x for i in items], "the position changed")

    @book.rule(SERVICE, flavours=ARDUPILOT)
    def item_zero_is_home(self) -> None:
        """Item 0 is home, regardless of the item uploaded there."""
        home = self.home()
        items = self.square(2)
        items[0] = waypoint(123_456_789, 98_765_432, 77.0)
        self.require_upload(items)
        first = self.download()[0]
        off = max(abs(first.x - home.latitude), abs(first.y - home.longitude))
        require(off < 100, f"item 0 is at {first.x}, {first.y}")

    @book.rule(f"{SERVICE}; {mav.OBSERVED_PX4}; {mav.OBSERVED_ARDUPILOT}")
    def items_are_requested_in_order(self) -> None:
        """Items are requested one by one from 0, with the flavour's message, then acknowledged."""
        items = self.square(3)
        kind = REQUESTS[1 if self.is_px4 else 0]
        self.send_count(len(items))
        for number, item in enumerate(items):
            request = self.await_request(number)
            require(isinstance(request, kind), f"requested by {request.get_type()}")
            self.send_item(item, number)
        require(self.await_ack() == 0, "not accepted")

    @book.rule(SERVICE)
    def legacy_request_gets_an_int_item(self) -> None:
        """MISSION_REQUEST is answered by MISSION_ITEM_INT (or the legacy item)."""
        self.prepare()
        self.begin_download()
        self.send(mav.ItemRequest(*self.target, 1, mav.MISSION))
        kinds = (mav.Item, mavlink.MAVLink_mission_item_message)
        try:
            answer = self.expect(kinds, mark=self.asked, within_s=ACK_S)
        finally:
            self.finish_download()
        require(getattr(answer, "seq", None) == 1, brief(answer))

    @book.rule(SERVICE)
    def repeated_request_is_answered_again(self) -> None:
        """An item requested twice, because it was lost, is sent twice."""
        self.prepare()
        self.begin_download()
        first, second = self.request_item(1), self.request_item(1)
        self.finish_download()
        require(first.lasting_fields == second.lasting_fields, "two different items")

    @book.rule(SERVICE)
    def plans_are_stored_apart(self) -> None:
        """Uploads of fence and rally points leave the mission unchanged, and vice versa."""
        wanted = self.prepare()
        self.require_upload(self.circle(), mav.FENCE)
        self.require_upload(self.rally(), mav.RALLY)
        self.require_stored(wanted)
        require(len(self.download(mav.FENCE)) == 1, "the fence changed")
        require(self.clear() == 0, "not cleared")
        require(len(self.download(mav.RALLY)) == 1, "the rally points went with the mission")
        self.clear(mav.FENCE)
        self.clear(mav.RALLY)

    @book.rule(SERVICE)
    def new_mission_replaces_the_old_one(self) -> None:
        """A second upload replaces the first."""
        self.prepare(4)
        self.require_stored(self.prepare(2))

    @book.rule(SERVICE)
    def empty_upload_clears(self) -> None:
        """MISSION_COUNT 0 clears the mission and is acknowledged."""
        self.prepare()
        self.send_count(0)
        require(self.await_ack() == 0, "not acknowledged")
        self.require_stored([])

    @book.rule(SERVICE)
    def clear_all_clears_one_kind(self) -> None:
        """MISSION_CLEAR_ALL clears its kind and is acknowledged, also when there is nothing."""
        self.prepare()
        for _ in range(2):
            require(self.clear() == 0, "not acknowledged")
        self.require_stored([])

    @book.rule(SERVICE, flavours=PX4)
    def clear_of_type_255_clears_everything(self) -> None:
        """MISSION_CLEAR_ALL of type ALL clears missions, fences and rally points."""
        self.prepare()
        self.require_upload(self.circle(), mav.FENCE)
        self.require_upload(self.rally(), mav.RALLY)
        require(self.clear(mav.ALL) == 0, "not acknowledged")
        for kind in (mav.MISSION, mav.FENCE, mav.RALLY):
            require(self.download(kind) == [], f"something of type {kind} is left")

    @book.rule(SERVICE)
    def empty_plan_has_count_zero(self) -> None:
        """A download without a plan is answered by MISSION_COUNT 0 (1 with ArduPilot's home)."""
        self.clear()
        self.require_stored([])
        self.clear(mav.FENCE)
        require(self.download(mav.FENCE) == [], "the fence is not empty")

    @book.rule(SERVICE)
    def request_beyond_the_end_is_an_error(self) -> None:
        """A request of an item that does not exist is answered by an error, not by an item."""
        self.prepare()
        self.begin_download()
        result = self.ack_of(mav.ItemIntRequest(*self.target, 500, mav.MISSION))
        errors = (mav.PLAN_ERROR, mav.PLAN_INVALID_SEQUENCE, mav.PLAN_INVALID)
        require(result in errors, f"ACK {result}")
        self.finish_download()
        self.run(0.5)

    @book.rule(f"{SERVICE} (partial lists are not standard)")
    def partial_lists_are_unsupported(self) -> None:
        """MISSION_WRITE_PARTIAL_LIST and MISSION_REQUEST_PARTIAL_LIST are answered UNSUPPORTED."""
        for kind in (
            mavlink.MAVLink_mission_write_partial_list_message,
            mavlink.MAVLink_mission_request_partial_list_message,
        ):
            result = self.ack_of(kind(*self.target, 0, 1, mav.MISSION))
            require(result == mav.PLAN_UNSUPPORTED, f"{kind.msgname}: ACK {result}")

    @book.rule(f"{SERVICE}, MAV_MISSION_TYPE_ALL")
    def type_all_is_for_clearing_only(self) -> None:
        """Upload and download of type ALL, or of a type that does not exist, are UNSUPPORTED."""
        wanted = self.prepare()
        for kind in (mav.ALL, 77):
            for message in (mav.Count(*self.target, 1, kind), mav.PlanRequest(*self.target, kind)):
                result = self.ack_of(message)
                problem = f"{message.msgname} of type {kind}: ACK {result}"
                require(result == mav.PLAN_UNSUPPORTED, problem)
        self.require_stored(wanted)

    @book.rule(f"{SERVICE}, Rally Points")
    def rally_points_survive(self) -> None:
        """A rally point is downloaded as it was uploaded."""
        (wanted,) = self.rally()
        self.require_upload([wanted], mav.RALLY)
        found = [item.lasting_fields for item in self.download(mav.RALLY)]
        self.clear(mav.RALLY)
        expected = [wanted.lasting_fields]
        require(found == expected, f"{found}, not {expected}")

    @book.rule("MAVLink guide, Routing")
    def plans_for_another_system_are_ignored(self) -> None:
        """MISSION_CLEAR_ALL and MISSION_COUNT for another system change nothing."""
        wanted = self.prepare()
        mark = self.mark
        self.send(mav.Clear(77, 1, mav.MISSION))
        self.send(mav.Count(77, 1, 0, mav.MISSION))
        self.expect_none(mav.PlanAck, mark=mark, what="acknowledged")
        self.require_stored(wanted)

    @book.rule(f"{SERVICE} (MISSION_CURRENT)")
    def current_item_can_be_set(self) -> None:
        """DO_SET_MISSION_CURRENT moves MISSION_CURRENT; a number beyond the end is refused."""
        self.prepare(4)
        self.require_sent(mav.Current, SET_CURRENT, 2.0, 0.0, where=lambda m: m.seq == 2)
        require(self.command(SET_CURRENT, 90.0, 0.0) != mav.ACCEPTED, "90 is accepted")
        message = mavlink.MAVLink_mission_set_current_message(*self.target, 1)
        self.ask(message, mav.Current, lambda m: m.seq == 1)

    @book.rule(f"{SERVICE} (MISSION_CURRENT)", flavours=PX4)
    def mission_current_reports_total_and_state(self) -> None:
        """MISSION_CURRENT reports the total and the state: no mission, then not started."""
        self.clear()
        self.run(1.5)
        state = self.request(mav.Current).mission_state
        require(state in (0, 1), f"without a mission: state {state}")
        self.prepare()
        self.run(1.5)
        current = self.request(mav.Current)
        require(current.total == 3, f"total {current.total}")
        require(current.mission_state in (0, 2), f"state {current.mission_state}")

    @book.rule(f"{SERVICE}; MAVSDK mission progress", effect=FLIES)
    def mission_is_flown_and_reported(self) -> None:
        """A started mission reaches its items in order, as MISSION_ITEM_REACHED reports."""
        items = self.prepare(3)
        first = 0 if self.is_px4 else 1
        self.watch(mav.Current, 0.5)
        self.take_off()
        self.require_mode("mission")
        mark = self.asked
        self.await_mode("mission")
        last = first + len(items) - 1
        self.expect(mav.Reached, lambda m: m.seq == last, within_s=90.0, mark=mark)
        reached = [m.seq for m in self.heard(mav.Reached, mark)]
        require(sorted(set(reached)) == list(range(first, last + 1)), f"reached {reached}")
        require(reached == sorted(reached), f"reached {reached}")
        self.run(2.5)
        state = self.latest(mav.Current).mission_state
        require(state in (0, 5), f"state {state} at the end")
        self.clear()

    @book.rule("MAVLink common, MAV_CMD_MISSION_START", effect=FLIES)
    def mission_start_starts_it(self) -> None:
        """MISSION_START in the air flies the mission."""
        self.prepare(2)
        self.take_off()
        self.require_result(mav.ACCEPTED, mavlink.MAV_CMD_MISSION_START, 0.0, 0.0)
        mark = self.asked
        self.await_mode("mission")
        self.expect(mav.Reached, within_s=60.0, mark=mark)
        self.clear()
