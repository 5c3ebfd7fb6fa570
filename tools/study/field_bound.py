"""Prints errors of the field radios along their flights and the best possible accuracy.

It is the Cramer-Rao bound of the scenario's own model: thermal noise, Gauss-Markov errors of the
vehicle's position and height about their current value, and the priors of offset, height and
bearing offset with which the estimator is configured. Without reflections no estimator beats it.
With them, as spatially correlated errors of the same variance, it is the smallest error of a linear
estimator. Every measurement arrives, and the noise is known. Received power has no bound here.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from companion.domain import FlightMode
from companion.entry import ignore_broken_pipe
from companion.errors import CompanionError
from companion.estimation.filters.target_filter import FilterParams
from companion.io.files import check_writable
from companion.kernel import Matrix, Vector
from sim_link.autopilot.scenario import Scenario
from sim_link.lab.lockstep import Flight, MemoryJournal
from sim_link.world.environment import in_the_field
from sim_link.world.point_mass import EulerAngles
from sim_link.world.radio_channel import AntennaModelParams, direction_enu, seen_by_antenna
from tools.console import OneLineParser, done_by, non_negative, positive
from tools.run_study import STUDIES
from tools.study.field_flights import FieldFlight, flights_of
from tools.study.reporting.study_tables import studies_of

STEP = 1e-4
COMPASS = 3
NORMALS = np.random.default_rng(0).standard_normal((4000, 2))


SHARES = (0.2, 0.4, 0.6, 0.8, 1.0)
"""Shares of a flight after which error and bound are compared."""


def flown(task: FieldFlight) -> tuple[Matrix, Vector]:
    """Return the true path, (n, 7): time, position, attitude at each measurement; and errors (n,).

    An error is that of the estimate at the time, in the vehicle's frame; NaN if there is none yet.
    """
    notes = MemoryJournal()
    flight = Flight(task.config, task.scenario, task.seed, notes)
    vehicle, rows, errors_m = flight.sim.vehicle, [], []
    due_s, engaged_s, truth = 0.0, math.inf, task.scenario.emitter.position_enu_m
    while not notes.results and flight.now_s < engaged_s + task.cut_s:
        flight.step()
        if flight.mode is FlightMode.OFFBOARD:
            engaged_s = min(engaged_s, flight.now_s)
            if flight.now_s >= due_s:
                due_s = flight.now_s + 1.0 / task.scenario.payload.rate_hz
                body = vehicle.body
                rows.append((flight.now_s, *body.position_enu_m, *body.attitude))
                estimate, bias = flight.companion.session.estimate, vehicle.estimator.bias_enu_m
                shown_m = (truth[0] + bias[0], truth[1] + bias[1])
                position = None if estimate is None else estimate.position_enu_m
                errors_m.append(math.nan if position is None else math.dist(position, shown_m))
    return np.array(rows), np.array(errors_m)


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
    step_sigma_m = in_the_field(channel).range_step_m / math.sqrt(12.0)
    partials, sigmas, about = [], [], []
    for time_s, east, north, up, *angles in way.tolist():
        position, attitude = (east, north, up), EulerAngles(*angles)
        away = truth - position
        if scenario.payload.measures != "bearing":
            partials.append([*(away / np.linalg.norm(away)), 0.0, 1.0])
            sigmas.append(math.hypot(channel.range_sigma_m, step_sigma_m))
            about.append((time_s, *position, 0.0))
        if scenario.payload.measures == "range":
            continue
        u = seen_by_antenna(direction_enu(position, tuple(truth)), attitude, antenna, 0.0)
        values = np.array(directions(u, antenna))
        columns = []
        for which in range(4):
            moved = truth + STEP * np.eye(4, 3)[which]
            turn_rad = STEP if which == COMPASS else 0.0
            there = direction_enu(position, tuple(moved))
            seen = directions(seen_by_antenna(there, attitude, antenna, turn_rad), antenna)
            columns.append((np.array(seen) - values) / STEP if len(seen) == len(values) else None)
        if any(column is None for column in columns):
            continue
        # an azimuth errs by 1 / flat of an angle in space, the unit of noise and bends
        flat = math.hypot(u[0], u[1]) if antenna.kind == "planar" else 1.0
        for row in range(len(values)):
            partials.append([*(flat * float(c[row]) for c in columns if c is not None), 0.0])
            sigmas.append(sigma_rad)
            about.append((time_s, *position, 1.0 + row))
    return np.array(partials), np.array(sigmas), np.array(about)


def bound_m2(way: Matrix, scenario: Scenario, priors: FilterParams, *, reflects: bool) -> Matrix:
    """Return the bound on the position at the end of a path, in the vehicle's frame, (2, 2).

    Priors of the height, of the bearing and of the range offset are those of the estimator.

    Raises `LinAlgError` if the path does not determine the position.
    """
    partials, sigmas, about = linearised(way, scenario)
    navigation, channel = scenario.navigation, in_the_field(scenario.channel)
    ago_s = about[:, 0] - about[:, 0].max()

    def wander(sigma_m: float, tau_s: float) -> Matrix:
        """Return the covariance, (n, n), of an error's change since each time."""
        kept = np.exp(ago_s / tau_s)
        apart = np.exp(-np.abs(ago_s[:, None] - ago_s[None]) / tau_s)
        walked: Matrix = sigma_m**2 * (apart - kept[:, None] - kept[None] + 1.0)
        return walked

    noise = np.diag(sigmas**2)
    noise += wander(navigation.sigma_m, navigation.time_constant_s) * (
        partials[:, :2] @ partials[:, :2].T
    )
    noise += wander(navigation.height_sigma_m, navigation.height_time_constant_s) * np.outer(
        partials[:, 2], partials[:, 2]
    )
    if reflects:
        p, mean_m = channel.p_nlos, channel.range_bias_mean_m
        bend_rad = math.sqrt(p) * math.radians(channel.bearing_bias_sigma_deg)
        range_m = math.sqrt(2.0 * p - p * p) * mean_m
        size = np.where(about[:, 4] == 0.0, range_m, bend_rad)
        apart = np.linalg.norm(about[:, None, 1:4] - about[None, :, 1:4], axis=2)
        is_alike = about[:, None, 4] == about[None, :, 4]
        noise += is_alike * np.outer(size, size) * np.exp(-apart / max(channel.correlation_m, 1e-3))
    height_m2 = navigation.height_sigma_m**2 + priors.target_height_sigma_m**2
    least_m2 = max(priors.range_offset_sigma_m, 1e-3) ** 2
    least_rad2 = max(math.radians(priors.bearing_offset_sigma_deg), 1e-3) ** 2
    prior = np.diag([0.0, 0.0, 1.0 / height_m2, 1.0 / least_rad2, 1.0 / least_m2])
    information = partials.T @ np.linalg.solve(noise, partials) + prior
    return np.asarray(np.linalg.inv(information)[:2, :2])


def median_m(covariance_m2: Matrix) -> float:
    """Return the median distance of a Gaussian of that covariance."""
    return float(np.median(np.hypot(*(NORMALS @ np.linalg.cholesky(covariance_m2).T).T)))


def compared(task: FieldFlight) -> Matrix:
    """Fly; return error and bounds without and with reflections after each share, (s, 3), m."""
    way, errors_m = flown(task)
    found, priors = np.full((len(SHARES), 3), math.nan), task.config.tracking.filter
    for index, share in enumerate(SHARES):
        count = int(share * len(way))
        if count:
            found[index, 0] = errors_m[count - 1]
        for column, reflects in ((1, False), (2, True)):
            try:
                covariance_m2 = bound_m2(way[:count], task.scenario, priors, reflects=reflects)
                found[index, column] = median_m(covariance_m2)
            except (np.linalg.LinAlgError, IndexError, ValueError):
                continue  # nothing seen yet, or nothing that determines a position
    return found


def flights_to_compare(runs: int, seed: int, radios: Sequence[str]) -> list[FieldFlight]:
    """Return configured latched crossings of these radios, or of all without power."""
    grid = studies_of("field", STUDIES)[0].flights
    assert grid is not None
    only = [*radios, "configured", "latched_crossing"]
    flights = flights_of(grid, STUDIES.parent, runs, seed, only)
    return [task for task in flights if task.scenario.payload.measures != "power"]


def table(medians: dict[str, Matrix]) -> str:
    """Return a Markdown table of each radio's medians (s, 3), and the error over the bounds."""
    lines = [
        "| radio | of flight | error, m | bound, m | with reflections, m | error over bounds |",
        "|---|---|---|---|---|---|",
    ]
    for radio, found in medians.items():
        for share, (error_m, free_m, bent_m) in zip(SHARES, found.tolist(), strict=True):
            about = f"| {radio} | {share:.0%} | {error_m:.2f} | {free_m:.2f} | {bent_m:.2f} | "
            lines.append(f"{about}{error_m / free_m:.2f}, {error_m / bent_m:.2f} |")
    return "\n".join(lines)


def plot(medians: dict[str, Matrix], path: Path) -> None:
    """Draw the error over both bounds along the flight, a line for each radio."""
    from tools.study.reporting.plots import panels_of

    figure, (panels,) = panels_of(2, 2, 3.8, 3.25, sharex=True, sharey=True)
    names = ("bound without reflections", "linear bound with reflections")
    for column, (panel, name) in enumerate(zip(panels, names, strict=True), 1):
        for radio, found in medians.items():
            panel.semilogy(SHARES, found[:, 0] / found[:, column], "o-", label=radio)
        panel.axhline(1.0, color="0.5", linewidth=1.0)
        panel.set_title(name)
        panel.set_xlabel("share of the flight")
    panels[0].set_ylabel("median error over median bound")
    panels[0].legend(frameon=False, fontsize="small")
    figure.savefig(path, dpi=120)


def main() -> None:
    """Print a table of the medians over flights, and draw it."""
    parser = OneLineParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("radios", nargs="*", help="scenarios of configs/scenarios/field; all")
    parser.add_argument("--runs", type=positive, default=12, help="flights of each radio")
    parser.add_argument("--seed", type=non_negative, default=2)
    parser.add_argument("--jobs", type=positive, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--plot", type=Path, metavar="PNG", help="draw error over bound there")
    arguments = parser.parse_args()
    try:
        if arguments.plot is not None:
            check_writable(arguments.plot)
        flights = flights_to_compare(arguments.runs, arguments.seed, arguments.radios)
        found: dict[str, list[Matrix]] = {task.radio: [] for task in flights}
        results = done_by(compared, flights, arguments.jobs, lambda task: task.cut_s)
        for task, each in zip(flights, results, strict=True):
            found[task.radio].append(each)
    except CompanionError as error:
        parser.error(str(error))
    medians = {radio: np.nanmedian(np.stack(each), axis=0) for radio, each in found.items()}
    print(f"medians of {arguments.runs} flights a radio, seed {arguments.seed}\n")
    print(table(medians))
    if arguments.plot is not None:
        plot(medians, arguments.plot)


if __name__ == "__main__":
    ignore_broken_pipe()
    main()
