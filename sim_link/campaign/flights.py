"""Flights as campaigns fly them: with faults, an operator and a monitor."""

from __future__ import annotations

from dataclasses import dataclass

from companion.config.schema import CompanionConfig
from companion.flight_setup import build_endpoint
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.scenario import Scenario
from sim_link.campaign.signed import KEY, STARTED_UNIX_S, SignedPair
from sim_link.faults.faulty_link import FaultyLink
from sim_link.faults.injector import Injector
from sim_link.faults.schedule import Schedule
from sim_link.lockstep.checkpoints import Checkpointing
from sim_link.lockstep.flight import Flight, MakeCompanion
from sim_link.lockstep.journal import Notes
from sim_link.lockstep.operator import Operator
from sim_link.monitor.monitor import Monitor
from sim_link.monitor.rules import Rules


def rules_of(config: CompanionConfig) -> Rules:
    """What a configuration promises, as the monitor judges it."""
    limits = config.limits
    return Rules(
        fence_enu_m=limits.fence_enu_m,
        system_id=config.vehicle.system_id,
        keep_out_enu_m=limits.keep_out_enu_m,
        altitude_min_m=limits.altitude_min_m,
        altitude_max_m=limits.altitude_max_m,
        speed_mps=limits.speed_mps,
        climb_mps=limits.climb_mps,
        acceleration_mps2=limits.acceleration_mps2,
        step_m=limits.step_m,
        latency_s=limits.latency_s,
        navigation_sigma_m=limits.navigation_sigma_m,
    )


def snapshot_of(flight: Flight) -> object:
    """What the companion acts by, to be compared."""
    companion = flight.companion
    session, vehicle = companion.session, companion.session.vehicle
    return (
        session.phase,
        session.estimate,
        vehicle.heartbeat,
        vehicle.position_enu_m,
        vehicle.home_enu_m,
        vehicle.origin,
        vehicle.landed,
        companion.binding.system_id,
        companion.binding.peer,
        companion.binding.heard_s,
    )


@dataclass(slots=True)
class Monitored:
    """A flight and everybody around it."""

    flight: Flight
    link: FaultyLink
    operator: Operator
    injector: Injector
    monitor: Monitor
    notes: Notes
    checkpointing: Checkpointing


def monitored(
    config: CompanionConfig,
    scenario: Scenario,
    seed: int,
    *,
    is_signed: bool = False,
    is_spoofing: bool | None = None,
    make_companion: MakeCompanion | None = None,
) -> Monitored:
    """A flight that has not begun yet.

    Args:
        config: The companion's.
        scenario: The vehicle's.
        seed: Of everything random.
        is_signed: Whether the link is signed.
        is_spoofing: Whether attackers use the vehicle's address; None: where the link is signed.
        make_companion: Starts the companion, in place of the genuine one.
    """
    pair = SignedPair() if is_signed else None
    key = KEY if is_signed else None
    notes, link = Notes(), FaultyLink(Schedule(), seed, key=key)
    genuine = build_endpoint if pair is None else pair.companion
    flight = Flight(
        config,
        scenario,
        seed,
        notes,
        wire=link,
        make_companion=make_companion or genuine,
        make_simulator=SimEndpoint if pair is None else pair.simulator,
    )
    operator = Operator(flight, pair.station if pair else None, STARTED_UNIX_S)
    monitor = Monitor(
        rules_of(config),
        flight.sim.vehicle,
        estimate=lambda: flight.companion.session.estimate,
        snapshot=lambda: snapshot_of(flight),
        key=key,
        dropped=lambda: flight.companion.dropped_unread,
    )
    flight.observers.append(monitor)
    injector = Injector(
        flight, link, operator, is_spoofing=is_signed if is_spoofing is None else is_spoofing
    )
    checkpointing = Checkpointing(flight)
    return Monitored(flight, link, operator, injector, monitor, notes, checkpointing)
