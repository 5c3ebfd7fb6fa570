"""Other ranging messages on a link of their own, other planners, setpoints and clocks."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.config.schema import CompanionConfig
from companion.domain import FlightMode, RangingMeasurement
from companion.geometry.coordinates import bearing_ned_from_enu, wrap_pi
from companion.guidance.commands import SessionParams
from companion.guidance.emitters import Order, QueueParams
from companion.link.interface import VehicleParams
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink, message_from_ranging
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.scenario import Scenario
from sim_link.world.environment import EmitterParams
from tests.loop.loop_helpers import AUTO, Loop

pytestmark = pytest.mark.slow

EMITTER = (50.0, 50.0, 0.0)
UNIX_S = 1.795e9
HEARD_FROM_M = 3.0


class Radio:
    """A radio that hears the emitter at (50, 50) with a little noise, in one of three messages.

    Args:
        form: The message it speaks.
        clock_s: Reading of its clock at the start of the flight.
    """

    def __init__(self, form: str, clock_s: float = 0.0) -> None:
        self._form = form
        self._clock_s = clock_s
        self._codec = MavCodec(1, mavlink.MAV_COMP_ID_PERIPHERAL)
        self._rng = np.random.default_rng(5)

    def __call__(self, sim: SimEndpoint, now_s: float) -> bytes | None:
        body = sim.vehicle.body
        if body.height_m < HEARD_FROM_M:
            return None
        noise_m, noise_rad = self._rng.standard_normal(2).tolist()
        east, north, _ = body.position_enu_m
        range_m = math.dist(body.position_enu_m, EMITTER) + 0.5 * noise_m
        bearing_enu_rad = math.atan2(EMITTER[1] - north, EMITTER[0] - east) + 0.03 * noise_rad
        stamp_us = round(1e6 * (self._clock_s + now_s)) if self._clock_s >= 0.0 else 0
        return self._codec.encode(
            self._message(stamp_us, range_m, bearing_enu_rad, body.yaw_ned_rad)
        )

    def _message(self, stamp_us: int, range_m: float, bearing: float, yaw: float) -> Message:
        if self._form == "LANDING_TARGET":
            from_nose_rad = wrap_pi(bearing_ned_from_enu(bearing) - yaw)
            return mavlink.MAVLink_landing_target_message(
                stamp_us,
                3,
                mavlink.MAV_FRAME_BODY_FRD,
                from_nose_rad,
                0.0,
                range_m,
                0.0,
                0.0,
                type=mavlink.LANDING_TARGET_TYPE_RADIO_BEACON,
            )
        if self._form == "RANGING_BEACON":
            fields = dict.fromkeys(mavlink.MAVLink_ranging_beacon_message.fieldnames, 0)
            fields |= {"time_usec": stamp_us, "beacon_id": 3, "range": round(1e3 * range_m)}
            return mavlink.MAVLink_ranging_beacon_message(**fields)
        measurement = RangingMeasurement(
            emitter_id=3, measured_at_s=0.0, range_m=range_m, bearing_enu_rad=bearing
        )
        return message_from_ranging(measurement, stamp_us)


@pytest.mark.parametrize("form", ["RADIO_RANGING", "LANDING_TARGET", "RANGING_BEACON"])
def test_any_ranging_message_on_a_second_link_finds_the_emitter(form: str) -> None:
    loop = Loop(payload_source=Radio(form))
    # ranges alone settle above the radius to stop at, which takes `mission.settle_s` longer
    limit_s = 200.0 if form == "RANGING_BEACON" else 150.0
    loop.run_until(lambda: bool(loop.notes.results), limit_s)
    assert loop.error_m <= 1.5


@pytest.mark.parametrize(("order", "turns"), [("nearest", [1, 2]), ("strongest", [2, 1])])
def test_emitters_have_their_turns_by_nearness_or_by_what_the_radio_says(
    order: Order, turns: list[int]
) -> None:
    near = EmitterParams(emitter_id=1, position_enu_m=(30.0, 25.0), quality=0.2)
    loud = EmitterParams(emitter_id=2, position_enu_m=(60.0, 55.0), quality=0.9)
    mission = SessionParams(engage="auto", stop_radius_m=1.9, stop_confirm_s=2.0)
    config = CompanionConfig(mission=mission, emitters=QueueParams(order=order))
    loop = Loop(config, Scenario(emitter=near, emitters=(loud,)))
    loop.run_until(lambda: len(loop.notes.results) == 2, 240.0)
    assert [report.emitter_id for _, report in loop.notes.results] == turns


@pytest.mark.parametrize("clock_s", [UNIX_S, -1.0], ids=["unix time", "no clock"])
def test_a_radio_may_keep_its_own_time(clock_s: float) -> None:
    loop = Loop(payload_source=Radio("RADIO_RANGING", clock_s))
    loop.run_until(lambda: bool(loop.notes.results), 150.0)
    assert loop.error_m <= 1.5
    assert loop.companion.session.status(loop.now_s).refused == {}


def test_global_setpoints_fly_the_same_search() -> None:
    config = CompanionConfig(
        mission=SessionParams(engage="auto"), vehicle=VehicleParams(setpoint="global_int")
    )
    loop, local = Loop(config), Loop(AUTO)
    for flight in (loop, local):
        flight.run_until(lambda flight=flight: bool(flight.notes.results), 120.0)  # type: ignore[misc]
    assert loop.error_m <= 1.5
    assert loop.now_s == pytest.approx(local.now_s, abs=5.0)
    loop.run(1.0)
    assert loop.mode is FlightMode.HOLD
