"""Fences that are parameters, read by name."""

from __future__ import annotations

import struct

import pytest

from companion.domain import Autopilot
from companion.guidance.events import FenceLimits
from companion.link.autopilot_fence import NAMES, PARAMETER_TRIES, FenceParameters
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink

INT8, INT32, REAL32 = 2, 6, 9
ARDUPILOT = {"FENCE_ENABLE": 1.0, "FENCE_TYPE": 7.0, "FENCE_RADIUS": 40.0, "FENCE_ALT_MAX": 100.0}


def value(name: str, number: float, kind: int = REAL32) -> Message:
    if kind == INT32:  # as PX4 sends it: its bytes in the float
        (number,) = struct.unpack("<f", struct.pack("<i", int(number)))
    message = mavlink.MAVLink_param_value_message(name.encode(), number, kind, 900, 17)
    return MavCodec(9, 9).decode(MavCodec(1, 1).encode(message))[0]


def limits_of(parameters: dict[str, float]) -> FenceLimits:
    reader = FenceParameters()
    for name, number in parameters.items():
        reader.receive(value(name, number), Autopilot.ARDUPILOT)
    return reader.limits


@pytest.mark.parametrize(
    ("changes", "limits"),
    [
        ({}, FenceLimits(40.0, 100.0)),
        ({"FENCE_ENABLE": 0.0}, FenceLimits()),
        ({"FENCE_ENABLE": 0.0, "FENCE_AUTOENABLE": 1.0}, FenceLimits(40.0, 100.0)),
        ({"FENCE_TYPE": 2.0, "FENCE_MARGIN": 4.0}, FenceLimits(40.0, margin_m=4.0)),
        ({"FENCE_TYPE": 4.0}, FenceLimits()),
        ({"FENCE_TYPE": 8.0, "FENCE_ALT_MIN": 10.0}, FenceLimits(altitude_min_m=10.0)),
    ],
)
def test_ardupilots_parts_hold_where_type_and_enable_say_so(
    changes: dict[str, float], limits: FenceLimits
) -> None:
    assert limits_of(ARDUPILOT | changes) == limits


@pytest.mark.parametrize(("action", "limits"), [(2, FenceLimits(60.0, 30.0)), (0, FenceLimits())])
def test_px4s_distances_hold_unless_its_action_is_none(action: int, limits: FenceLimits) -> None:
    reader = FenceParameters()
    for message in (
        value("GF_MAX_HOR_DIST", 60.0),
        value("GF_MAX_VER_DIST", 30.0),
        value("GF_ACTION", action, INT32),
    ):
        reader.receive(message, Autopilot.PX4)
    assert reader.limits == limits


def test_a_change_is_noticed_once() -> None:
    reader = FenceParameters()
    for name, number in ARDUPILOT.items():
        reader.receive(value(name, number), Autopilot.ARDUPILOT)
    assert not reader.receive(value("FENCE_RADIUS", 40.0), Autopilot.ARDUPILOT)
    assert reader.receive(value("FENCE_RADIUS", 30.0), Autopilot.ARDUPILOT)
    assert not reader.receive(value("WPNAV_SPEED", 30.0), Autopilot.ARDUPILOT)


def test_each_is_asked_for_a_few_times_and_no_more_than_that() -> None:
    reader, asked = FenceParameters(), 0
    for tick in range(2000):
        asked += reader.due(0.05 * tick, Autopilot.ARDUPILOT, (1, 1)) is not None
    assert asked == PARAMETER_TRIES * len(NAMES[Autopilot.ARDUPILOT])
    assert reader.due(1e6, Autopilot.OTHER, (1, 1)) is None


def test_the_strictest_of_two_has_the_least_of_each() -> None:
    one = FenceLimits(40.0, None, 3.0, 2.0)
    other = FenceLimits(60.0, 20.0, 5.0, 1.0)
    assert one.strictest(other) == FenceLimits(40.0, 20.0, 5.0, 2.0)
