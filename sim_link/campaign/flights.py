"""Flights as campaigns fly them: with faults, an operator and a monitor."""

from __future__ import annotations

from dataclasses import dataclass

from companion.config.schema import CompanionConfig
from companion.mav.signing import SigningKey
from sim_link.autopilot.scenario import Scenario
from sim_link.faults.faulty_link import FaultyLink
from sim_link.faults.injector import Injector
from sim_link.faults.schedule import Schedule
from sim_link.lockstep.flight import Flight, MakeCompanion, MakeSimulator
from sim_link.lockstep.journal import Notes
from sim_link.lockstep.operator import Operator
from sim_link.monitor.monitor import Monitor
from sim_link.monitor.rules import Rules


def rules_of(config: CompanionConfig) -> Rules:
    """What a configuration promises, as the monitor judges it."""
    limits = config.limits
    return Rules(
        fence_enu_m=limits.fence_enu_m,
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


@dataclass(slots=True)
class Monitored:
    """A flight and everybody around it."""

    flight: Flight
    link: FaultyLink
    operator: Operator
    injector: Injector
    monitor: Monitor
    notes: Notes


def monitored(
    config: CompanionConfig,
    scenario: Scenario,
    seed: int,
    *,
    key: SigningKey | None = None,
    make_companion: MakeCompanion | None = None,
    make_simulator: MakeSimulator | None = None,
) -> Monitored:
    """A flight that has not begun yet.

    Args:
        config: The companion's.
        scenario: The vehicle's.
        seed: Of everything random.
        key: Of the link, where it is signed.
        make_companion: Starts the companion; None: as its command does.
        make_simulator: Switches the vehicle on; None: an unsigned one.
    """
    notes, link = Notes(), FaultyLink(Schedule(), seed, key=key)
    makers: dict[str, MakeCompanion | MakeSimulator] = {}
    if make_companion is not None:
        makers["make_companion"] = make_companion
    if make_simulator is not None:
        makers["make_simulator"] = make_simulator
    flight = Flight(config, scenario, seed, notes, wire=link, **makers)  # type: ignore[arg-type]
    operator = Operator(flight)
    monitor = Monitor(
        rules_of(config),
        flight.sim.vehicle,
        estimate=lambda: flight.companion.session.estimate,
        key=key,
    )
    flight.observers.append(monitor)
    injector = Injector(flight, link, operator, is_spoofing=key is not None)
    return Monitored(flight, link, operator, injector, monitor, notes)
