"""A flight whose radio prints what a real one would, along with RADIO_RANGING of the same draws."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from companion.config.schema import CompanionConfig
from companion.domain import RangingMeasurement
from companion.flight_setup import build_endpoint
from companion.link.interface import VEHICLE_ONLY, LinkRole, LinkSpec
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink, message_from_ranging
from companion.mav.endpoint import Chunk
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.scenario import Scenario
from sim_link.emulators.emulator import Answer, Emulator, Round
from sim_link.lab.lockstep import RADIO_PEER, Flight, MemoryJournal
from sim_link.lab.observer import Frame, Lane, Observer
from sim_link.lab.radio_follower import seen_from_nose
from sim_link.world.environment import Emitter
from sim_link.world.field_radio import FieldRadio

MULTIPATH_SIGMA_M = 20.0
"""Sigma that the decoders of cells state for multipath."""
Coarsen = Callable[[RangingMeasurement], RangingMeasurement]


def as_it_is(heard: RangingMeasurement) -> RangingMeasurement:
    """Return the measurement unchanged."""
    return heard


TENTH_NS_M = 0.5 * 299_792_458.0 * 1e-10
"""One-way range of a step in a cell's metrics, which round the way there and back."""


def of_a_cell(step_m: float, *, is_cut_off: bool = True, is_nearest: bool = False) -> Coarsen:
    """The middle of a step of the timing advance, and what a decoder counts for its error.

    Where it is not cut off, to the last digit of the metrics; `is_nearest`: the nearest step.
    """
    sigma_m = math.hypot(step_m / math.sqrt(12.0), MULTIPATH_SIGMA_M)

    def coarsen(heard: RangingMeasurement) -> RangingMeasurement:
        assert heard.range_m is not None
        range_m = (heard.range_m // step_m + 0.5) * step_m
        if is_nearest:
            range_m = max(0, round(heard.range_m / step_m)) * step_m
        if not is_cut_off:
            range_m = TENTH_NS_M * round(heard.range_m / TENTH_NS_M)
        return replace(heard, range_m=range_m, range_sigma_m=sigma_m)

    return coarsen


def in_steps(step_m: float, step_deg: float | None = None) -> Coarsen:
    """The nearest whole step of a range, and of the angles with it; None: angles as they are."""

    def coarsen(heard: RangingMeasurement) -> RangingMeasurement:
        rounded: dict[str, Any] = {}
        if heard.range_m is not None:
            rounded["range_m"] = step_m * round(heard.range_m / step_m)
        if step_deg is not None:
            for name in ("bearing_body_rad", "elevation_rad"):
                angle_rad = getattr(heard, name)
                if angle_rad is not None:
                    steps = round(math.degrees(angle_rad) / step_deg)
                    rounded[name] = math.radians(step_deg * steps)
        return replace(heard, **rounded)

    return coarsen


def in_degrees(heard: RangingMeasurement) -> RangingMeasurement:
    """A bearing in whole ones."""
    assert heard.bearing_body_rad is not None
    return replace(heard, bearing_body_rad=_whole(heard.bearing_body_rad))


def in_degrees_about_an_upright(heard: RangingMeasurement) -> RangingMeasurement:
    """Two arcsines whose azimuth and elevation come in whole degrees."""
    assert heard.bearing_body_rad is not None
    assert heard.elevation_rad is not None
    right, up = math.sin(heard.bearing_body_rad), math.sin(heard.elevation_rad)
    ahead = math.sqrt(max(0.0, 1.0 - right * right - up * up))
    azimuth_rad, elevation_rad = _whole(math.atan2(right, ahead)), _whole(heard.elevation_rad)
    across_rad = math.asin(math.sin(azimuth_rad) * math.cos(elevation_rad))
    return replace(heard, bearing_body_rad=across_rad, elevation_rad=elevation_rad)


def of_a_gateway(heard: RangingMeasurement) -> RangingMeasurement:
    """The signal's share of a LoRa channel's whole decibels; its noise is -117 dBm."""
    assert heard.power_dbm is not None
    channel_dbm = round(10.0 * math.log10(10.0 ** (0.1 * heard.power_dbm) + 10.0**-11.7))
    snr_db = min(round(heard.power_dbm + 117.0, 1), 14.0)
    power_dbm = channel_dbm - 10.0 * math.log10(1.0 + 10.0 ** (-0.1 * snr_db))
    return replace(heard, power_dbm=power_dbm)


def to_five_degrees(heard: RangingMeasurement) -> RangingMeasurement:
    """Angles in hundredths, with the standard deviation that the locator's emulator prints."""
    sigma_rad = math.radians(5.0)
    return replace(
        in_steps(1.0, 0.01)(heard), bearing_sigma_rad=sigma_rad, elevation_sigma_rad=sigma_rad
    )


def _whole(angle_rad: float) -> float:
    return math.radians(round(math.degrees(angle_rad)))


class EmulatedRadio:
    """Measures from the vehicle's true position as the simulator's own radio does.

    Args:
        emulator: Prints the measurements.
        reference: Receives RADIO_RANGING of the same draws.
        coarsen: Cuts from those what the emulator's format cuts.
        has_clock: The emulator's format reports times.
    """

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        emulator: Emulator,
        reference: Callable[[bytes, float], None] | None = None,
        coarsen: Coarsen = as_it_is,
        *,
        has_clock: bool = True,
    ) -> None:
        payload = scenario.payload
        rng = np.random.default_rng(seed)
        self._radio = FieldRadio(
            scenario.channel, rng, scenario.environment, payload.antenna, payload.measures
        )
        self._emitter = Emitter(scenario.emitter)
        self._radio.prepare(self._emitter)
        self._least_m = payload.min_altitude_m
        self._emulator = emulator
        self._reference = reference
        self._codec = MavCodec(1, mavlink.MAV_COMP_ID_PERIPHERAL)
        self._coarsen = coarsen
        self._has_clock = has_clock
        self._boot = emulator.banner

    def __call__(self, sim: SimEndpoint, now_s: float) -> bytes | None:
        heard = self._heard(sim, now_s)
        if heard is not None and self._reference is not None:
            clock_us = round(1e6 * now_s) if self._has_clock else 0
            message = message_from_ranging(self._coarsen(heard), clock_us)
            self._reference(self._codec.encode(message), now_s)
        if heard is not None and not self._emulator.reports_north:
            heard = seen_from_nose(heard, sim.vehicle.body.yaw_ned_rad)
        asked = Round(now_s, (Answer(self._emitter.emitter_id, heard),))
        printed, self._boot = self._boot + self._emulator.say(asked), b""
        return printed or None

    def _heard(self, sim: SimEndpoint, now_s: float) -> RangingMeasurement | None:
        body = sim.vehicle.body
        if body.height_m < self._least_m:
            return None
        return self._radio.hear(self._emitter, body.position_enu_m, now_s, body.attitude)


class Passenger(Observer):
    """A second companion aboard: it receives what the first does, its output reaches no vehicle.

    Two flights differ in all that follows from the last digit of one measurement: in a tie of two
    legs, or in which of a measurement and a tick comes first. Estimates of one path do not. Its own
    control ends once it notices the first as another source of setpoints.
    """

    def __init__(self, flight: Flight, config: CompanionConfig) -> None:
        links = (*VEHICLE_ONLY, LinkSpec(LinkRole.RANGING))
        self.companion = build_endpoint(config, MemoryJournal(), links)
        self._flight = flight
        flight.observers.append(self)
        self._wake()

    def heard(self, frame: Frame) -> None:
        if frame.lane is Lane.TO_COMPANION:
            self.companion.receive(Chunk(0, frame.data, frame.peer), frame.time_s)

    def ranging(self, data: bytes, now_s: float) -> None:
        """Take a RADIO_RANGING."""
        self.companion.receive(Chunk(1, data, RADIO_PEER), now_s)

    def _wake(self) -> None:
        self.companion.handle_timer(self._flight.now_s)
        self.companion.take_output()
        self._flight.at(self.companion.next_timer_s(), self._wake)
