"""Random fields in every message that the services take: no crash, answers that can be sent."""

from __future__ import annotations

import random

import pytest

from companion.mav.codec import MavCodec, frame_crc
from companion.mav.dialect import MAVLink_command_cancel_message, Message, mavlink
from companion.mav.payloads import targets_of_frame
from sim_link.autopilot.ardupilot import firmware_profile as ardupilot
from sim_link.autopilot.protocols import parameter_protocol
from sim_link.autopilot.protocols.addressing import (
    Addressing,
    Channel,
    Outgoing,
    Partner,
    StatusTexts,
    partner_of,
)
from sim_link.autopilot.protocols.command_protocol import (
    Clocks,
    Command,
    CommandForms,
    CommandResult,
    Commands,
)
from sim_link.autopilot.protocols.link_layer import Router
from sim_link.autopilot.protocols.message_streams import MessageRequests, StreamProfile
from sim_link.autopilot.protocols.mission_protocol import Plans
from sim_link.autopilot.protocols.parameter_protocol import ParameterStore
from sim_link.autopilot.protocols.plan_items import PlanStore, PlanType
from sim_link.autopilot.px4 import firmware_profile as px4

pytestmark = pytest.mark.slow

KINDS: tuple[type[Message], ...] = (
    mavlink.MAVLink_command_long_message,
    mavlink.MAVLink_command_int_message,
    mavlink.MAVLink_set_mode_message,
    MAVLink_command_cancel_message,
    mavlink.MAVLink_mission_count_message,
    mavlink.MAVLink_mission_item_int_message,
    mavlink.MAVLink_mission_item_message,
    mavlink.MAVLink_mission_request_int_message,
    mavlink.MAVLink_mission_request_message,
    mavlink.MAVLink_mission_request_list_message,
    mavlink.MAVLink_mission_ack_message,
    mavlink.MAVLink_mission_clear_all_message,
    mavlink.MAVLink_mission_set_current_message,
    mavlink.MAVLink_mission_write_partial_list_message,
    mavlink.MAVLink_param_set_message,
    mavlink.MAVLink_param_request_read_message,
    mavlink.MAVLink_param_request_list_message,
    mavlink.MAVLink_request_data_stream_message,
    mavlink.MAVLink_timesync_message,
    mavlink.MAVLink_ping_message,
    mavlink.MAVLink_system_time_message,
)
NAMES = (b"MIS_TAKEOFF_ALT", b"RTL_ALT", b"_HASH_CHECK", b"SYSID_THISMAV", b"GF_ACTION")
SPECIAL = (b"\0\0\xc0\x7f", b"\0\0\x80\x7f", b"\xff\xff\x7f\xff", b"\0\0\0\0", b"\0\0\x80\x3f")
"""NaN, infinity, the most negative float, 0 and 1."""
STREAMS = StreamProfile({0: 1.0, 30: 50.0, 148: 0.0}, 0.004, groups={10: (30,)})
FRAMES = 20_000


class Services:
    """All of a vehicle's services, which obey every request."""

    def __init__(self, *, is_ardupilot: bool) -> None:
        texts = StatusTexts()
        table = ardupilot.ARDUPILOT_PARAMETERS if is_ardupilot else px4.PX4_PARAMETERS
        firmware = ardupilot.FIRMWARE if is_ardupilot else px4.FIRMWARE
        self.store = ParameterStore(table)
        self.parameters = parameter_protocol.Parameters(self.store, firmware.parameters, texts)
        self.plan_store = PlanStore()
        self.plans = Plans(self.plan_store, firmware.plans, texts)
        self.commands = Commands(CommandForms())
        self.requests = MessageRequests(STREAMS, px4.FIRMWARE.requests, lambda _: None, texts)
        self.clocks = Clocks(Addressing(1))
        self.router = Router(1, (1,), links=2)

    def handle(self, message: Message, partner: Partner, now_s: float) -> list[Outgoing]:
        outgoing = self.parameters.handle(message, partner, now_s)
        outgoing += self.plans.handle(message, partner, now_s)
        self.requests.set_data_stream(message, partner, now_s)
        todo, answers = self.commands.receive(message, partner, now_s)
        outgoing += answers
        if isinstance(todo, Command):
            asked = self.requests.handle_command(todo, now_s)
            result, replies = asked or (CommandResult.IN_PROGRESS, [])
            outgoing += [*replies, self.commands.answer(todo, result, now_s)]
        for answer in (
            self.clocks.timesync(message, partner, now_s),
            self.clocks.ping(message, partner),
        ):
            if answer is not None:
                outgoing.append(Outgoing(answer, partner.channel))
        return outgoing

    def step(self, now_s: float) -> list[Outgoing]:
        self.requests.take_due(now_s)
        self.plan_store.take_events()
        return self.parameters.handle_timer(now_s) + self.plans.handle_timer(now_s)


def random_frame(rng: random.Random) -> bytes:
    """A frame with a right CRC and anything in its fields, mostly for us."""
    kind = rng.choice(KINDS)
    payload = bytearray(rng.randbytes(kind.unpacker.size))
    if rng.random() < 0.5:
        at = 4 * rng.randrange(max(1, len(payload) // 4))
        payload[at : at + 4] = rng.choice(SPECIAL)[: len(payload) - at]
    if kind is mavlink.MAVLink_param_set_message and rng.random() < 0.7:
        payload[6:22] = rng.choice(NAMES).ljust(16, b"\0")
    if "mission_type" in kind.fieldnames and rng.random() < 0.7:
        payload[-1] = rng.randrange(3)
    if kind is mavlink.MAVLink_mission_count_message:
        payload[0:2] = rng.choice((bytes(2), b"\2\0", b"\5\0", rng.randbytes(2)))
    source = (rng.randrange(1, 256), rng.randrange(256))
    header = bytes((0xFD, len(payload), 0, 0, rng.randrange(256), *source))
    frame = header + kind.id.to_bytes(3, "little") + payload
    return frame + frame_crc(frame, kind.crc_extra).to_bytes(2, "little")


@pytest.mark.parametrize("is_ardupilot", [False, True])
def test_random_fields_never_crash_a_service(is_ardupilot: bool) -> None:
    rng = random.Random(20_261)
    services = Services(is_ardupilot=is_ardupilot)
    receiver, sender = MavCodec(1, 1), MavCodec(1, 1)
    addressing, answered, now_s = Addressing(1), 0, 0.0
    for _ in range(FRAMES):
        now_s += 0.001
        frame = random_frame(rng)
        channel = Channel(0, ("127.0.0.1", rng.randrange(1, 40)))
        services.router.route(frame, channel)
        (message,) = receiver.decode(frame)
        system_id, _ = targets_of_frame(frame)
        outgoing = services.step(now_s)
        if addressing.is_for_us(message) or system_id > 100:  # as if it had been for us
            outgoing += services.handle(message, partner_of(message, channel), now_s)
        for each in outgoing:
            assert sender.encode(each.message)
            answered += 1
    assert answered > FRAMES / 10
    stored, again = services.store.to_text(), ParameterStore(services.store.specs)
    again.load_text(stored, "what was stored")
    assert again.to_text() == stored
    assert sum(len(services.plan_store.items(kind)) for kind in PlanType) < 1000
