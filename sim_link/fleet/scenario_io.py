"""Files about one flight: its scenario read from YAML, its ground truth as plain JSON."""

from __future__ import annotations

from pathlib import Path

import msgspec

from companion.config.loader import load_yaml
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.incidents import renew_scenario
from sim_link.autopilot.scenario import Scenario


def load_scenario(path: Path) -> Scenario:
    """Return the scenario of a YAML file, canonical where it says nothing.

    `ConfigError`: it is wrong.
    """
    return load_yaml(path, Scenario, renew_scenario)


def start_report(endpoint: SimEndpoint, seed: int, speed: float) -> dict[str, object]:
    """Return state and truth at the start: metres, degrees counter-clockwise, about `origin`."""
    vehicle, scenario = endpoint.vehicle, endpoint.vehicle.scenario
    return {
        "version": 1,  # of this form
        "state": "running",
        "scenario": scenario.name,
        "seed": seed,
        "speed": speed,
        "system_id": scenario.system_id,
        "time_limit_s": scenario.time_limit_s,
        "origin": msgspec.to_builtins(scenario.origin),
        "area_m": list(scenario.area_m),
        "start_enu_m": list(vehicle.home_enu_m),
        "emitter": _emitter(endpoint, scenario),
        "offsets": {
            "range_m": scenario.channel.range_offset_m,
            "bearing_deg": scenario.channel.bearing_offset_deg,
        },
        "channel": msgspec.to_builtins(scenario.channel),
        "obstacles": msgspec.to_builtins(scenario.obstacles),
        "shadow": msgspec.to_builtins(scenario.shadow),
    }


def end_report(endpoint: SimEndpoint, seed: int, speed: float) -> dict[str, object]:
    """Return the start report with `state` "ended" and what was flown."""
    vehicle, recorder = endpoint.vehicle, endpoint.recorder
    return start_report(endpoint, seed, speed) | {
        "state": "ended",
        "simulated_s": vehicle.time_s,
        "distance_m": vehicle.aircraft.distance_m,
        "flight_time_s": vehicle.aircraft.flight_time_s,
        "is_armed": vehicle.is_armed,
        "setpoints_received": vehicle.setpoints.received,
        "setpoints_refused": vehicle.setpoints.refused,
        "longest_setpoint_gap_s": vehicle.setpoints.longest_gap_s,
        "mode_changes": [
            {"time_s": change.time_s, "mode": change.mode.value, "text": change.text}
            for change in recorder.mode_changes
        ],
        "track": [[round(value, 3) for value in point] for point in recorder.track],
    }


def _emitter(endpoint: SimEndpoint, scenario: Scenario) -> dict[str, object]:
    position_enu_m = (*scenario.emitter.position_enu_m, scenario.emitter.height_m)
    names = ("latitude_deg", "longitude_deg", "altitude_m")
    place = endpoint.vehicle.origin.geodetic_from_enu(position_enu_m)
    emitter = {"id": scenario.emitter.emitter_id, "enu_m": list(position_enu_m)}
    return emitter | dict(zip(names, place, strict=True))
