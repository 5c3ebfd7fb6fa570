"""A flight whose radio prints what a real one would, or RADIO_RANGING of the same draws."""

from __future__ import annotations

import numpy as np

from companion.domain import RangingMeasurement
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from companion.mav.ranging import message_from_ranging
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.scenario import Scenario
from sim_link.emulators.emulator import Answer, Emulator, Round
from sim_link.lab.radio_follower import seen_from_nose
from sim_link.world.environment import Emitter
from sim_link.world.field_radio import FieldRadio


class EmulatedRadio:
    """Measures from the vehicle's true place as the simulator's own does.

    Args:
        emulator: Who prints; None: RADIO_RANGING.
    """

    def __init__(self, scenario: Scenario, seed: int, emulator: Emulator | None) -> None:
        payload = scenario.payload
        rng = np.random.default_rng(seed)
        self._radio = FieldRadio(
            scenario.channel, rng, scenario.environment, payload.antenna, payload.measures
        )
        self._emitter = Emitter(scenario.emitter)
        self._radio.prepare(self._emitter)
        self._least_m = payload.min_altitude_m
        self._emulator = emulator
        self._codec = MavCodec(1, mavlink.MAV_COMP_ID_PERIPHERAL)
        self.measured = 0

    def __call__(self, sim: SimEndpoint, now_s: float) -> bytes | None:
        heard = self._heard(sim, now_s)
        self.measured += heard is not None
        if self._emulator is None:
            if heard is None:
                return None
            return self._codec.encode(message_from_ranging(heard, round(1e6 * now_s)))
        if heard is not None and not self._emulator.tells_north:
            heard = seen_from_nose(heard, sim.vehicle.body.yaw_ned_rad)
        asked = Round(now_s, (Answer(self._emitter.emitter_id, heard),))
        return self._emulator.tell(asked) or None

    def _heard(self, sim: SimEndpoint, now_s: float) -> RangingMeasurement | None:
        body = sim.vehicle.body
        if body.height_m < self._least_m:
            return None
        return self._radio.hear(self._emitter, body.position_enu_m, now_s, body.attitude)
