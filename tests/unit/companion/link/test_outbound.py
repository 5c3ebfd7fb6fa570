from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.domain import Autopilot, FlightMode, PositionEnu, PositionSetpoint
from companion.errors import LocalProtocolError
from companion.geometry.coordinates import LocalOrigin
from companion.guidance.commands import TakeOff
from companion.link import outbound
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink

ORIGIN = LocalOrigin(47.397742, 8.545594, 488.0)
LocalTarget = mavlink.MAVLink_set_position_target_local_ned_message
GlobalTarget = mavlink.MAVLink_set_position_target_global_int_message


def over_the_wire(message: Message) -> Message:
    (received,) = MavCodec(9, 9).decode(MavCodec(1, 191).encode(message))
    return received


@pytest.mark.parametrize(("yaw", "mask"), [(None, 0x0DF8), (0.0, 0x09F8), (1.5, 0x09F8)])
def test_a_local_setpoint_is_north_east_down_in_frame_1(yaw: float | None, mask: int) -> None:
    setpoint = PositionSetpoint((2.0, 1.0, 3.0), yaw)
    message = over_the_wire(outbound.local_setpoint(setpoint, 12.3456, (7, 1)))
    assert isinstance(message, LocalTarget)
    assert (message.x, message.y, message.z) == (1.0, 2.0, -3.0)
    assert (message.coordinate_frame, message.type_mask) == (1, mask)
    assert (message.target_system, message.target_component) == (7, 1)
    assert message.time_boot_ms == 12345
    assert message.yaw == (yaw or 0.0)


@pytest.mark.parametrize(("yaw", "mask"), [(None, 0x0DF8), (1.5, 0x09F8)])
def test_a_global_setpoint_is_above_sea_level_in_frame_5(yaw: float | None, mask: int) -> None:
    setpoint = PositionSetpoint((20.0, 10.0, 30.0), yaw)
    message = over_the_wire(outbound.global_setpoint(setpoint, ORIGIN, 1.0, (7, 1)))
    assert isinstance(message, GlobalTarget)
    assert (message.coordinate_frame, message.type_mask) == (5, mask)
    position = ORIGIN.enu_from_geodetic(message.lat_int / 1e7, message.lon_int / 1e7, message.alt)
    assert position == pytest.approx((20.0, 10.0, 30.0), abs=0.02)
    assert message.alt == pytest.approx(518.0, abs=1e-3)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("axis", [0, 1, 2, 3])
def test_a_setpoint_that_is_not_finite_is_our_own_mistake(bad: float, axis: int) -> None:
    values = [0.0, 0.0, 10.0, 0.5]
    values[axis] = bad
    position: PositionEnu = (values[0], values[1], values[2])
    setpoint = PositionSetpoint(position, values[3])
    with pytest.raises(LocalProtocolError, match="not finite"):
        outbound.local_setpoint(setpoint, 0.0, (1, 1))
    with pytest.raises(LocalProtocolError, match="not finite"):
        outbound.global_setpoint(setpoint, ORIGIN, 0.0, (1, 1))


def test_the_stamp_wraps_and_never_overflows() -> None:
    assert outbound.time_boot_ms(2**32 / 1000.0 + 1.5) == 1500


def test_the_heartbeat_is_an_onboard_controllers() -> None:
    message = over_the_wire(outbound.heartbeat())
    assert isinstance(message, mavlink.MAVLink_heartbeat_message)
    assert (message.type, message.autopilot) == (18, 8)
    assert (message.base_mode, message.custom_mode, message.system_status) == (0, 0, 4)
    assert message.get_srcComponent() == 191


def test_px4_takes_off_to_an_altitude_above_sea_level() -> None:
    message = outbound.take_off(TakeOff(20.0, 1.5), ORIGIN, Autopilot.PX4).message((1, 1))
    assert message.command == 22
    assert message.param7 == 509.5


def test_ardupilot_takes_off_to_a_height_and_sees_no_nan() -> None:
    message = outbound.take_off(TakeOff(20.0, 1.5), ORIGIN, Autopilot.ARDUPILOT).message((1, 1))
    params = [getattr(message, f"param{n}") for n in range(1, 8)]
    assert params == [0.0] * 6 + [20.0]


def test_arming_is_never_forced() -> None:
    message = outbound.arm().message((1, 1), 2)
    assert (message.command, message.param1, message.param2) == (400, 1.0, 0.0)
    assert message.confirmation == 2


@pytest.mark.parametrize(
    ("autopilot", "mode", "is_armed", "params"),
    [
        (Autopilot.PX4, FlightMode.OFFBOARD, False, (1.0, 6.0, 0.0)),
        (Autopilot.PX4, FlightMode.HOLD, True, (129.0, 4.0, 3.0)),
        (Autopilot.ARDUPILOT, FlightMode.OFFBOARD, True, (129.0, 4.0, 0.0)),
        (Autopilot.ARDUPILOT, FlightMode.HOLD, True, (129.0, 17.0, 0.0)),
    ],
)
def test_modes_are_asked_for_in_the_autopilots_numbers(
    autopilot: Autopilot, mode: FlightMode, is_armed: bool, params: tuple[float, float, float]
) -> None:
    message = outbound.set_mode(mode, autopilot, is_armed=is_armed).message((1, 1))
    assert message.command == 176
    assert (message.param1, message.param2, message.param3) == params


# Texts


def chunks_of(text: str) -> list[tuple[int, int, bytes]]:
    """Id, chunk number and bytes up to the first NUL, of each message as sent."""
    found = []
    for message in outbound.status_text(4, text, 9):
        frame = MavCodec(1, 191).encode(message)
        assert isinstance(over_the_wire(message), mavlink.MAVLink_statustext_message)
        payload = frame[10 : 10 + frame[1]].ljust(54, b"\0")
        assert payload[0] == 4
        text_id = int.from_bytes(payload[51:53], "little")
        found.append((text_id, payload[53], payload[1:51].split(b"\0")[0]))
    return found


def test_a_short_text_is_one_message_without_an_id() -> None:
    assert chunks_of("hold: autopilot link lost") == [(0, 0, b"hold: autopilot link lost")]
    assert chunks_of("x" * 50) == [(0, 0, b"x" * 50)]
    assert chunks_of("") == [(0, 0, b"")]


def test_a_long_text_is_numbered_chunks_with_one_id() -> None:
    assert chunks_of("a" * 50 + "b" * 20) == [(9, 0, b"a" * 50), (9, 1, b"b" * 20)]


def test_a_text_that_fills_its_chunks_still_ends_with_a_nul() -> None:
    assert [data for _, _, data in chunks_of("a" * 100)] == [b"a" * 50, b"a" * 50, b""]
    assert [len(data) for _, _, data in chunks_of("a" * 500)] == [50, 50, 50, 49]


def test_no_character_is_cut_in_two() -> None:
    assert [data.decode() for _, _, data in chunks_of("a" * 49 + "é" + "b")] == ["a" * 49, "éb"]


@pytest.mark.slow
@given(st.text())
def test_any_text_arrives_or_its_beginning_does(text: str) -> None:
    sent = text.encode("utf-8", errors="replace").decode().split("\0")[0]
    pieces = chunks_of(sent)
    joined = "".join(data.decode("utf-8") for _, _, data in pieces)
    assert sent.startswith(joined)
    assert joined == sent or len(joined.encode()) > 190
    if len(pieces) > 1:
        assert len(pieces[-1][2]) < 50
