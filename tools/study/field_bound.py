"""Prints the best possible accuracy of a field radio along the flown ways.

It is the Cramer-Rao bound of the scenario's own model: thermal noise, Gauss-Markov errors of the
vehicle's position and height about their present value, offset, height and compass as the study
draws them. Without reflections no estimator beats it. With them, as spatially correlated errors of
the same variance, it is the least error of a linear estimator. Every measurement arrives, and all
these parameters are known.
"""

from __future__ import annotations

import math

import numpy as np

from companion.domain import FlightMode
from companion.entry import ignore_broken_pipe
from companion.kernel import Matrix, Vector
from sim_link.autopilot.scenario import Scenario
from sim_link.lab.lockstep.flight import Flight, MemoryJournal
from sim_link.world.antenna import AntennaModelParams, direction_enu, seen_by_antenna
from sim_link.world.environment import in_the_field
from sim_link.world.point_mass import EulerAngles
from tools.console import OneLineParser
from tools.run_study import STUDIES
from tools.study.field_flights import FieldFlight, flights_of
from tools.study.reporting.study_tables import studies_of

STEP = 1e-4
COMPASS, OFFSET, PARAMETERS = 3, 4, 5
NORMALS = np.random.default_rng(0).standard_normal((4000, 2))


def flown(task: FieldFlight) -> tuple[Matrix, float]:
    """Return the true way, (n, 7): time, position, attitude at each measurement; and the error."""
    notes = MemoryJournal()
    flight = Flight(task.config, task.scenario, task.seed, notes)
    body, rows, due_s, engaged_s = flight.sim.vehicle.body, [], 0.0, math.inf
    while not notes.results and flight.now_s < engaged_s + task.cut_s:
        flight.step()
        if flight.mode is FlightMode.OFFBOARD:
            engaged_s = min(engaged_s, flight.now_s)
            if flight.now_s >= due_s:
                due_s = flight.now_s + 1.0 / task.scenario.payload.rate_hz
                rows.append((flight.now_s, *body.position_enu_m, *body.attitude))
    estimate, bias = flight.companion.session.estimate, flight.sim.vehicle.estimator.bias_enu_m
    if estimate is None:
        return np.array(rows), math.nan
    truth = task.scenario.emitter.position_enu_m
    shown = (truth[0] + bias[0], truth[1] + bias[1])
    return np.array(rows), math.dist(estimate.position_enu_m, shown)


def directions(u: tuple[float, float, float], antenna: AntennaModelParams) -> list[float]:
    """Return the antenna's measurement of a direction in its frame; empty outside its view."""
    x, y, z = u
    view_rad = math.radians(antenna.field_of_view_deg or 360.0)
    if antenna.kind == "planar":
        return [math.atan2(y, x)]
    if math.acos(min(1.0, abs(x))) > 0.5 * view_rad:
        return []
    return [y, z] if antenna.kind == "two_axis" else [y]


def linearised(way: Matrix, scenario: Scenario) -> tuple[Matrix, Vector, Matrix]:
    """Return partials (m, 5), sigmas (m,), and of each value time, position and kind, (m, 5)."""
    truth = np.array([*scenario.emitter.position_enu_m, scenario.emitter.height_m])
    antenna, channel = scenario.payload.antenna, scenario.channel
    sigma_rad = math.radians(antenna.sigma_deg or channel.bearing_sigma_deg)
    partials, sigmas, about = [], [], []
    for time_s, east, north, up, *angles in way.tolist():
        place, attitude = (east, north, up), EulerAngles(*angles)
        away = truth - place
        if scenario.payload.measures != "bearing":
            partials.append([*(away / np.linalg.norm(away)), 0.0, 1.0])
            sigmas.append(math.hypot(channel.range_sigma_m, _step_sigma_m(scenario)))
            about.append((time_s, *place, 0.0))
        if scenario.payload.measures == "range":
            continue
        u = seen_by_antenna(direction_enu(place, tuple(truth)), attitude, antenna, 0.0)
        values = np.array(directions(u, antenna))
        columns = []
        for which in range(4):
            moved = truth + STEP * np.eye(4, 3)[which]
            turn_rad = STEP if which == COMPASS else 0.0
            there = direction_enu(place, tuple(moved))
            seen = directions(seen_by_antenna(there, attitude, antenna, turn_rad), antenna)
            columns.append((np.array(seen) - values) / STEP if len(seen) == len(values) else None)
        if any(column is None for column in columns):
            continue
        # an azimuth errs by 1 / flat of an angle in space, the unit of noise and bends
        flat = math.hypot(u[0], u[1]) if antenna.kind == "planar" else 1.0
        for row in range(len(values)):
            partials.append([*(flat * float(c[row]) for c in columns if c is not None), 0.0])
            sigmas.append(sigma_rad)
            about.append((time_s, *place, 1.0 + row))
    return np.array(partials), np.array(sigmas), np.array(about)


def _step_sigma_m(scenario: Scenario) -> float:
    return in_the_field(scenario.channel).range_step_m / math.sqrt(12.0)


def bound_m2(way: Matrix, scenario: Scenario, height_spread_m: float, *, reflects: bool) -> Matrix:
    """Return the bound on the final position, in the vehicle's frame, (2, 2)."""
    partials, sigmas, about = linearised(way, scenario)
    navigation, channel = scenario.navigation, in_the_field(scenario.channel)
    ago_s = about[:, 0] - about[:, 0].max()

    def wander(sigma_m: float, tau_s: float) -> Matrix:
        kept = np.exp(ago_s / tau_s)
        apart = np.exp(-np.abs(ago_s[:, None] - ago_s[None]) / tau_s)
        walked: Matrix = sigma_m**2 * (apart - kept[:, None] - kept[None] + 1.0)
        return walked

    noise = np.diag(sigmas**2)
    noise += wander(navigation.sigma_m, navigation.time_constant_s) * (
        partials[:, :2] @ partials[:, :2].T
    )
    height = wander(navigation.height_sigma_m, navigation.height_time_constant_s)
    noise += height * np.outer(partials[:, 2], partials[:, 2])
    if reflects:
        p, mean_m = channel.p_nlos, channel.range_bias_mean_m
        bend_rad = math.sqrt(p) * math.radians(channel.bearing_bias_sigma_deg)
        range_m = math.sqrt(2.0 * p - p * p) * mean_m
        size = np.where(about[:, 4] == 0.0, range_m, bend_rad)
        apart = np.linalg.norm(about[:, None, 1:4] - about[None, :, 1:4], axis=2)
        is_alike = about[:, None, 4] == about[None, :, 4]
        noise += is_alike * np.outer(size, size) * np.exp(-apart / max(channel.correlation_m, 1e-3))
    height_m2 = navigation.height_sigma_m**2 + height_spread_m**2 / 3.0
    turn_rad = math.radians(math.hypot(navigation.compass_error_deg, channel.bearing_offset_deg))
    prior = np.zeros(PARAMETERS)
    prior[2], prior[COMPASS] = 1.0 / height_m2, 1.0 / max(turn_rad, 1e-3) ** 2
    prior[OFFSET] = 3.0 / max(channel.range_offset_m, 1e-3) ** 2
    information = partials.T @ np.linalg.solve(noise, partials) + np.diag(prior)
    return np.asarray(np.linalg.inv(information)[:2, :2])


def median_m(covariance_m2: Matrix) -> float:
    """Return the median distance of a Gaussian of that covariance."""
    return float(np.median(np.hypot(*(NORMALS @ np.linalg.cholesky(covariance_m2).T).T)))


def main() -> None:
    """Print a row for each flight, and the medians."""
    parser = OneLineParser(description=__doc__)
    parser.add_argument("radio", help="a scenario of configs/scenarios/field")
    parser.add_argument("--runs", type=int, default=12)
    parser.add_argument("--seed", type=int, default=2)
    arguments = parser.parse_args()
    grid = studies_of("field", STUDIES)[0].flights
    assert grid is not None
    only = [arguments.radio, "configured", "latched_crossing"]
    rows = []
    print("median error, m: without reflections, linear with them; this flight's")
    for task in flights_of(grid, STUDIES.parent, arguments.runs, arguments.seed, only):
        way, error_m = flown(task)
        free, reflected = (
            median_m(bound_m2(way, task.scenario, grid.height_spread_m, reflects=reflects))
            for reflects in (False, True)
        )
        rows.append((free, reflected, error_m))
        print(f"{free:6.2f} {reflected:6.2f} {error_m:6.2f}", flush=True)
    print("{:6.2f} {:6.2f} {:6.2f}  medians".format(*np.nanmedian(np.array(rows), axis=0)))


if __name__ == "__main__":
    ignore_broken_pipe()
    main()
