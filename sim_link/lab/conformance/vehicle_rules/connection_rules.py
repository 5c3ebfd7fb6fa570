"""HEARTBEAT and routing: identity, addressing and forwarding."""

from __future__ import annotations

import itertools

from companion.mav.dialect import Message, mavlink
from sim_link.lab.conformance import mavlink_oracle as mav
from sim_link.lab.conformance.protocol_clients import ParameterClient
from sim_link.lab.conformance.rules import ARDUPILOT, CHANGES, FLIES, PX4, RuleBook, assume, require
from sim_link.lab.conformance.station import Station, brief, heartbeat, source_of
from sim_link.lab.conformance.vehicle_probe import VehicleProbe, is_ready

SERVICE = "MAVLink guide, Heartbeat/Connection Protocol"
PX4_MODES = f"PX4 px4_custom_mode.h; MAVSDK px4_custom_mode.h; {mav.OBSERVED_PX4}"
STATE = f"MAVLink common, MAV_STATE; {mav.OBSERVED_PX4}"
COPTERS = (
    mavlink.MAV_TYPE_QUADROTOR,
    mavlink.MAV_TYPE_HEXAROTOR,
    mavlink.MAV_TYPE_OCTOROTOR,
    mavlink.MAV_TYPE_TRICOPTER,
    mavlink.MAV_TYPE_HELICOPTER,
    mavlink.MAV_TYPE_COAXIAL,
)
PERIODS = 5
JITTER_S = 0.25


class HeartbeatRules(VehicleProbe):
    """Identity, mode and state of a vehicle."""

    book = RuleBook("heartbeat")

    @book.rule(SERVICE)
    def once_a_second(self) -> None:
        """HEARTBEAT is sent once a second."""
        self.run(PERIODS + 1.0)
        beats = [e for e in self.inbox if isinstance(e.message, mav.Heartbeat)]
        times = [e.time_s for e in beats if e.source == self.target]
        require(len(times) >= PERIODS, f"{len(times)} in {PERIODS + 1} s")
        for first, second in itertools.pairwise(times):
            gap_s = second - first
            require(abs(gap_s - 1.0) < JITTER_S, f"{gap_s:.2f} s between two")

    @book.rule(f"{SERVICE}; MAVSDK system_impl.cpp is_autopilot")
    def comes_from_component_one(self) -> None:
        """The autopilot is component 1: MAVSDK recognises no other."""
        require(self.target[1] == mavlink.MAV_COMP_ID_AUTOPILOT1, f"component {self.target[1]}")

    @book.rule(SERVICE)
    def reports_type_and_autopilot(self) -> None:
        """HEARTBEAT reports a multicopter, the flavour's autopilot and MAVLink version 3."""
        message = self.heartbeat()
        require(message.type in COPTERS, f"type {message.type}")
        wanted = mav.AUTOPILOT_OF[self.flavour]
        require(message.autopilot == wanted, f"autopilot {message.autopilot}")
        require(message.mavlink_version == 3, f"mavlink_version {message.mavlink_version}")

    @book.rule("MAVSDK mavsdk_impl.cpp (255/190 is the ground station)")
    def is_no_ground_station(self) -> None:
        """The vehicle is not at a ground station's address."""
        require(self.target != (255, 190), "the vehicle is 255/190")

    @book.rule("MAVLink common, MAV_MODE_FLAG")
    def custom_mode_flag_is_set(self) -> None:
        """base_mode has CUSTOM_MODE_ENABLED."""
        base_mode = self.heartbeat().base_mode
        require(bool(base_mode & mav.CUSTOM), f"base_mode {base_mode}")

    def _require_modes(self, *modes: str) -> None:
        """Choose modes, disarmed; HEARTBEAT must show each with the base_mode that is noted."""
        self.require_disarmed()
        try:
            for mode in modes:
                self.require_mode(mode)
                self.await_mode(mode, 3.0)
                shown = self.heartbeat().base_mode & ~mavlink.MAV_MODE_FLAG_HIL_ENABLED
                wanted = self.notes.base_modes[mode]
                require(shown == wanted, f"{mode}: base_mode {shown:#x}, not {wanted:#x}")
        finally:
            self.set_mode("hold" if self.is_px4 else "stabilized")

    @book.rule(PX4_MODES, effect=CHANGES, flavours=PX4)
    def px4_modes_are_packed(self) -> None:
        """custom_mode is main << 16 | sub << 24, and base_mode has the flags that PX4 sends."""
        self._require_modes("hold", "land", "return", "takeoff")

    @book.rule(PX4_MODES, effect=CHANGES, flavours=PX4)
    def px4_stick_modes_are_packed(self) -> None:
        """POSCTL and ALTCTL are shown with the manual-input and stabilise flags."""
        self._require_modes("position", "altitude")

    @book.rule(
        f"ArduPilot ArduCopter/mode.h; {mav.OBSERVED_ARDUPILOT}", effect=CHANGES, flavours=ARDUPILOT
    )
    def ardupilot_modes_are_numbered(self) -> None:
        """custom_mode is ArduCopter's mode number, and base_mode has the flags that it sends."""
        self.get_ready()
        self._require_modes(*[mode for mode in self.notes.base_modes if mode != "mission"])

    @book.rule(mav.OBSERVED_ARDUPILOT, effect=CHANGES, flavours=ARDUPILOT)
    def mode_change_is_reported_at_once(self) -> None:
        """A changed mode shows in a HEARTBEAT at once, without waiting for the next second."""
        self.get_ready()
        self.set_mode("stabilized")
        self.heartbeat()
        self.run(0.2)
        number = mav.custom_mode(self.flavour, "altitude")
        self.set_mode("altitude")
        mark = self.asked
        self.expect(mav.Heartbeat, lambda m: m.custom_mode == number, within_s=0.4, mark=mark)
        self.set_mode("stabilized")

    @book.rule(STATE)
    def disarmed_and_ready_is_standby(self) -> None:
        """Disarmed and ready to arm, system_status is STANDBY."""
        self.get_ready()
        message = self.heartbeat()
        require(message.system_status == mavlink.MAV_STATE_STANDBY, brief(message))

    @book.rule(STATE, flavours=PX4)
    def not_ready_is_uninit(self) -> None:
        """While arming would be refused, system_status is UNINIT and the prearm bit is bad."""
        is_booting = not is_ready(self.expect(mav.SysStatus, within_s=3.0))
        assume(is_booting, "it is ready already; seen only right after boot")
        message = self.from_vehicle(mav.Heartbeat)[-1]
        require(message.system_status == mavlink.MAV_STATE_UNINIT, brief(message))

    @book.rule("MAVLink common, MAV_MODE_FLAG_SAFETY_ARMED", effect=FLIES)
    def armed_flag_follows_arming(self) -> None:
        """base_mode has SAFETY_ARMED exactly while the vehicle is armed."""
        require(not self.is_armed(), "SAFETY_ARMED before arming")
        self.arm()
        require(self.is_armed(), "no SAFETY_ARMED after arming")
        self.require_result(mav.ACCEPTED, mav.ARM, 0.0, mav.FORCE_DISARM)
        require(not self.is_armed(), "SAFETY_ARMED after disarming")

    @book.rule("MAVLink common, MAV_STATE", effect=FLIES)
    def armed_and_flying_is_active(self) -> None:
        """In the air system_status is ACTIVE."""
        self.arm()
        on_ground = self.heartbeat()
        require(bool(on_ground.base_mode & mav.ARMED), brief(on_ground))
        wanted = mav.ACTIVE if self.is_px4 else mavlink.MAV_STATE_STANDBY
        require(on_ground.system_status == wanted, f"armed on the ground: {brief(on_ground)}")
        self.take_off()
        flying = self.heartbeat()
        require(flying.system_status == mav.ACTIVE, f"in the air: {brief(flying)}")


ROUTING = "MAVLink guide, Routing"
UNKNOWN_ID = 45_998
FOREIGN_KEY = b"\x5a" * 32
SETTLE_S = 0.3
CAMERA, ONBOARD = mavlink.MAV_TYPE_CAMERA, mavlink.MAV_TYPE_ONBOARD_CONTROLLER


class RoutingRules(ParameterClient):
    """Addressing of messages, and forwarding between peers."""

    book = RuleBook("routing")

    @property
    def _unknown_system(self) -> int:
        return 77 if self.target[0] != 77 else 78

    def _require_ignored(self, system: int, component: int) -> None:
        """A command to an address must be neither obeyed nor acknowledged."""
        self.send(request_version(system, component))
        mark = self.asked
        self.expect_none(mav.Ack, asks_for_message, mark=mark, what="acknowledged")
        self.expect_none(mav.Version, for_s=0.1, mark=mark, what="obeyed")
        self.require_hearing()

    def _require_obeyed(self, system: int, component: int) -> None:
        """A command to an address must be obeyed and acknowledged."""
        self.ask(request_version(system, component), mav.Version)
        self.expect(mav.Ack, lambda m: asks_for_message(m) and m.result == 0, mark=self.asked)

    @book.rule(ROUTING)
    def command_for_another_system_is_ignored(self) -> None:
        """A command for another system is neither obeyed nor acknowledged."""
        self._require_ignored(self._unknown_system, self.target[1])

    @book.rule(ROUTING)
    def command_for_another_component_is_ignored(self) -> None:
        """A command for another component of the same system is neither obeyed nor acknowledged."""
        self._require_ignored(self.target[0], 77)

    @book.rule(ROUTING)
    def broadcast_is_obeyed(self) -> None:
        """A command for system 0 and component 0 is obeyed."""
        self._require_obeyed(0, 0)

    @book.rule(ROUTING)
    def component_zero_is_obeyed(self) -> None:
        """A command for the right system and component 0 is obeyed."""
        self._require_obeyed(self.target[0], 0)

    @book.rule(ROUTING)
    def system_zero_is_obeyed(self) -> None:
        """A command for system 0 and the right component is obeyed."""
        self._require_obeyed(0, self.target[1])

    @book.rule("MAVLink guide, Command Protocol")
    def acknowledgement_names_the_asker(self) -> None:
        """COMMAND_ACK has the sender of the command as its target."""
        ack = self.ask(request_version(*self.target), mav.Ack, asks_for_message)
        target = (ack.target_system, ack.target_component)
        require(target == self.address, f"target {target}")

    def _companion(self) -> Station:
        """Return a companion of the same vehicle, with its own connection."""
        return self.another(self.target[0], 191, ONBOARD)

    def _require_not_forwarded(
        self, other: Station, target: tuple[int, int], what: str = "forwarded"
    ) -> None:
        """A command for a target must not reach a second station."""
        mark = other.mark
        self.send(request_version(*target))
        other.expect_none(mav.CommandLong, mark=mark, what=what)
        self.require_hearing()

    def _require_forwarded(self, frame: bytes) -> None:
        """Frames reach the companion unaltered."""
        other = self._companion()
        mark = len(other.datagrams)
        self.send_raw(frame)
        require(bool(frames_at(other, mark, frame)), "it was not forwarded")

    @book.rule(ROUTING)
    def broadcast_is_forwarded_unaltered(self) -> None:
        """A broadcast of one client reaches the others byte for byte."""
        other = self._companion()
        mark = len(other.datagrams)
        self.send(text_message(b"forward me"))
        arrived = frames_at(other, mark, b"forward me")
        require(len(arrived) >= 1, "the other client did not get it")
        require(len(arrived) == 1, f"the other client got it {len(arrived)} times")
        source = (arrived[0][5], arrived[0][6])
        require(source == self.address, f"it came as from {source}")

    @book.rule(f"{ROUTING}; PX4 1.15 and ArduCopter 4.5, observed in SITL")
    def heartbeats_of_others_are_forwarded(self) -> None:
        """A ground station hears the heartbeat of a companion on another connection."""
        mark = self.mark
        self._companion().send(heartbeat(ONBOARD))
        source = (self.target[0], 191)
        self.expect(mav.Heartbeat, lambda m: source_of(m) == source, mark=mark)

    @book.rule(ROUTING)
    def addressed_message_reaches_its_target(self) -> None:
        """A command for a companion reaches the connection where it was heard."""
        other = self._companion()
        mark = other.mark
        self.send(request_version(self.target[0], 191))
        other.expect(mav.CommandLong, mark=mark)

    @book.rule(ROUTING)
    def component_zero_reaches_the_whole_system(self) -> None:
        """A command for all components of a system reaches every connection where it was heard."""
        stations = (
            self.another(42, 191, ONBOARD),
            self.another(42, 100, CAMERA),
            self.another(43, 191, ONBOARD),
        )
        marks = [station.mark for station in stations]
        self.send(request_version(42, 0))
        for station, mark in zip(stations[:2], marks, strict=False):
            station.expect(mav.CommandLong, mark=mark)
        stations[2].expect_none(mav.CommandLong, mark=marks[2], what="leaked")

    @book.rule(ROUTING)
    def addressed_message_reaches_no_other(self) -> None:
        """A command for one component is not sent to where others were heard."""
        self._companion()
        self._require_not_forwarded(self.another(253, 190), (self.target[0], 191), "leaked")

    @book.rule(ROUTING)
    def message_for_the_vehicle_stays_with_it(self) -> None:
        """A command for the vehicle is not forwarded to its other clients."""
        self._require_not_forwarded(self._companion(), self.target)

    @book.rule(ROUTING)
    def unknown_target_reaches_none(self) -> None:
        """A command for a system that was never heard is not forwarded."""
        self._require_not_forwarded(self._companion(), (self._unknown_system, 1))

    @book.rule(ROUTING)
    def own_message_never_returns(self) -> None:
        """Messages of a client are not sent back to it."""
        self._companion()
        mark = len(self.datagrams)
        self.send(text_message(b"no echo please"))
        require(not frames_at(self, mark, b"no echo please"), "it came back")
        self.require_hearing()

    @book.rule(ROUTING)
    def unknown_message_is_forwarded(self) -> None:
        """A message that the vehicle cannot decode is forwarded all the same."""
        self._require_forwarded(mav.build_raw(UNKNOWN_ID, b"\x01\x02\x03\x04\x05", 17, self.spec()))

    @book.rule(ROUTING)
    def unauthenticated_frame_is_forwarded_unaltered(self) -> None:
        """A frame signed with a key unknown to the vehicle is forwarded with its signature."""
        message = text_message(b"signed by a stranger")
        frame = mav.build_frame(message, self.spec(incompat=mav.SIGNED))
        self._require_forwarded(mav.sign(frame, FOREIGN_KEY, 3, 10**13))

    @book.rule(f"{ROUTING}; MAVLink guide, Message Signing", harms=True)
    def signing_setup_is_never_forwarded(self) -> None:
        """SETUP_SIGNING, which holds a key, is never passed on."""
        other = self._companion()
        mark = len(other.datagrams)
        key = bytes(range(1, 33))
        for target in ((self.target[0], 191), (self._unknown_system, 1)):
            self.send(mavlink.MAVLink_setup_signing_message(*target, list(key), 0))
        require(not frames_at(other, mark, key), "the key was passed on")
        self.require_hearing()

    @book.rule(ROUTING)
    def reboot_of_a_system_clears_its_routes(self) -> None:
        """A system whose SYSTEM_TIME goes back has rebooted: components behind it are forgotten."""
        other = self.another(42, 1, ONBOARD)
        behind = Station(other.link, 42, 7, None)
        behind.send(heartbeat(CAMERA))
        self.send(request_version(42, 7))
        behind.run(SETTLE_S)
        is_routed = bool(behind.heard(mav.CommandLong))
        assume(is_routed, "commands are not forwarded to components behind a client")
        other.send(mav.SystemTime(0, 500_000))
        other.send(mav.SystemTime(0, 1_000))
        mark = behind.mark
        self.send(request_version(42, 7))
        behind.expect_none(mav.CommandLong, mark=mark, what="still routed")

    @book.rule(ROUTING, effect=CHANGES)
    def parameter_change_reaches_all_clients(self) -> None:
        """A changed parameter is sent to every client."""
        other = self._companion()
        name = self.float_name
        present = self.read(name)
        mark = other.mark
        self.write(name, present.value, present.kind)
        other.expect(mav.ParamValue, lambda m: m.param_id == name, mark=mark)


def request_version(system: int, component: int) -> Message:
    """Return a command that is harmless wherever it is obeyed."""
    return mav.CommandLong(system, component, mav.REQUEST, 0, mav.Version.id, *[0] * 6)


def asks_for_message(ack: mav.Ack) -> bool:
    """Return True if it acknowledges such a command."""
    return bool(ack.command == mav.REQUEST)


def text_message(text: bytes) -> Message:
    """Return a STATUSTEXT, a broadcast."""
    return mav.StatusText(6, text, 0, 0)


def frames_at(station: Station, mark: int, containing: bytes) -> list[bytes]:
    """Return the frames received by a station since `mark` that contain these bytes."""
    station.run(SETTLE_S)
    return [frame for frame in station.frames_since(mark) if containing in frame]
