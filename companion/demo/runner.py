"""Flies the demonstration on the simulator and says how well it went."""

from __future__ import annotations

import importlib.util
import math
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from companion.config.schema import CompanionConfig
from companion.demo.simulator_process import SimulatorProcess
from companion.domain import TargetEstimate
from companion.errors import CompanionError, ConfigError
from companion.geometry.polygons import Point
from companion.guidance.authority.state_machine import Phase
from companion.io.child_process import HOST, free_udp_port
from companion.io.files import check_writable, write_json_atomic
from companion.io.links.transports import FlightLink, UdpBind
from companion.io.shell import Clock
from companion.link.endpoint import CompanionEndpoint
from companion.link.interface import LinkRole, LinkSpec
from companion.run import FlightOptions, FlightView, fly, is_handed_over, prepare

FENCE_AROUND_AREA_M = 10.0
OBSTACLE_CLEARANCE_M = 5.0
"""Obstacles that end less than this below the search altitude are flown around."""
PICTURE_SUFFIXES = (".png", ".svg", ".pdf")
SILENCE_LIMIT_S = 10.0
"""Real seconds after which a simulator that is not heard is given up."""
LATE_S = 0.5
"""Of the flight: a wake-up later than this can cost the autopilot's mode."""

MakeViews = Callable[[CompanionConfig, Point], list[FlightView]]
"""Who watches a flight, by its configuration and the emitter's true place."""


@dataclass(frozen=True, slots=True)
class DemoOptions:
    """What the command line asked for."""

    seed: int
    speed: float
    scenario: Path | None
    autopilot: str | None
    """px4 or ardupilot; None: the scenario's."""
    json: Path | None
    plot: Path | None


class DemoWatch(FlightView):
    """Ends the flight once there is a reason, and keeps what is drawn."""

    def __init__(self, simulator: SimulatorProcess, limit_s: float) -> None:
        self._simulator = simulator
        self._limit_s = limit_s
        self._began_wall_s: float | None = None
        self.ended = ""
        """Why; empty: somebody interrupted it."""
        self.time_s = 0.0
        """Of the companion, at the last wake-up before the end."""
        self.worst_gap_s = 0.0
        """Of the flight, between two wake-ups."""
        self.estimates: list[tuple[float, float, float, float]] = []
        """(time_s, east_m, north_m, r95_m)"""
        self.crossings_enu_m: list[Point] = []

    @property
    def wall_s(self) -> float:
        """Real time since the flight began."""
        return 0.0 if self._began_wall_s is None else time.monotonic() - self._began_wall_s

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Keep the estimates, and the crossing points chosen."""
        place, r95_m = fields.get("position_enu_m"), fields.get("r95_m")
        if kind == "estimate" and isinstance(place, tuple) and isinstance(r95_m, float):
            self.estimates.append((now_s, place[0], place[1], r95_m))
        elif kind == "waypoint" and isinstance(place, tuple):
            self.crossings_enu_m.append((place[0], place[1]))

    def update(self, endpoint: CompanionEndpoint, now_s: float) -> None:
        """Ask for the end, as Ctrl-C does, if there is a reason."""
        if self.ended:
            return
        if self._began_wall_s is None:
            self._began_wall_s = time.monotonic()
        elif endpoint.binding.is_bound:
            self.worst_gap_s = max(self.worst_gap_s, now_s - self.time_s)
        self.time_s = now_s
        reason = self._end_reason(endpoint, now_s)
        if reason is not None:
            self.ended = reason
            signal.raise_signal(signal.SIGINT)

    def _end_reason(self, endpoint: CompanionEndpoint, now_s: float) -> str | None:
        if is_handed_over(endpoint):
            return "localised"
        if endpoint.session.phase is Phase.YIELD:
            return f"the autopilot left {endpoint.session.vehicle.guided_name}"
        if now_s > self._limit_s:
            return f"time limit of {self._limit_s:g} s"
        if not self._simulator.is_alive:
            return "the simulator ended"
        if endpoint.binding.heard_s is None and self.wall_s > SILENCE_LIMIT_S:
            return "nothing heard from the simulator; is the loopback interface up?"
        return None


@dataclass(frozen=True, slots=True)
class DemoResult:
    """How the flight ended."""

    is_localised: bool
    estimate: TargetEstimate | None
    ended: str
    time_s: float
    """Of the companion, at the report or at the end."""
    wall_s: float
    error_m: float | None
    """Of the estimate, against the truth."""


def run_demo(
    options: DemoOptions,
    config: CompanionConfig,
    make_views: MakeViews,
    at_end: Callable[[Path], None] | None = None,
) -> bool:
    """Fly it, print how it went, write what was asked for; whether the target was found."""
    if importlib.util.find_spec("sim_link") is None:
        raise CompanionError("the demo needs the simulator: pip install companion-sim-link")
    _check_outputs(options)
    prepare(config)  # before the simulator starts to count its time
    port = free_udp_port()
    with tempfile.TemporaryDirectory() as temporary:
        report = Path(temporary) / "sim-link.json"
        simulator = SimulatorProcess(
            report, options.seed, options.speed, options.scenario, port, options.autopilot
        )
        with simulator:
            truth = simulator.started_report()
            config = _demo_config(config, truth, temporary)
            watch = DemoWatch(simulator, float(truth["time_limit_s"]))
            links = [FlightLink(UdpBind(HOST, port), LinkSpec(LinkRole.VEHICLE))]
            views = [watch, *make_views(config, _emitter_enu_m(truth))]
            flight_options = FlightOptions(views=views, at_end=at_end)
            endpoint = fly(config, links, Clock(options.speed), flight_options)
            simulator.stop()
            result = _result(options, watch, endpoint, _emitter_enu_m(truth))
            _conclude(options, config, watch, result, simulator.report())
    return result.is_localised


def _emitter_enu_m(report: Mapping[str, Any]) -> Point:
    east_m, north_m = report["emitter"]["enu_m"][:2]
    return (float(east_m), float(north_m))


def _check_outputs(options: DemoOptions) -> None:
    """Refuse before the flight what could not be written after it."""
    for path in (options.json, options.plot):
        if path is not None:
            check_writable(path)
    if options.plot is not None and options.plot.suffix.lower() not in PICTURE_SUFFIXES:
        known = ", ".join(PICTURE_SUFFIXES)
        raise ConfigError(f"--plot {options.plot}: the name must end in {known}")


def _demo_config(
    config: CompanionConfig, truth: Mapping[str, Any], state_directory: str
) -> CompanionConfig:
    """The configuration, engaging by itself, fenced in around the scenario's area.

    It keeps out of the obstacles that reach its altitude, as an operator would configure it. The
    simulator has no key, and nothing is taken up from an earlier run or left for a later one.
    """
    low = -FENCE_AROUND_AREA_M
    east, north = (float(size) + FENCE_AROUND_AREA_M for size in truth["area_m"])
    keep_out = tuple(
        tuple((float(east), float(north)) for east, north in obstacle["corners_enu_m"])
        for obstacle in truth["obstacles"]
        if obstacle["height_m"] is None
        or obstacle["height_m"] > config.mission.altitude_m - OBSTACLE_CLEARANCE_M
    )
    change = msgspec.structs.replace
    try:
        limits = change(
            config.limits,
            fence_enu_m=((low, low), (east, low), (east, north), (low, north)),
            keep_out_enu_m=(*config.limits.keep_out_enu_m, *keep_out),
        )
    except ValueError as error:
        raise ConfigError(f"scenario {truth['scenario']}: {error}") from error
    return change(
        config,
        mission=change(config.mission, engage="auto"),
        limits=limits,
        link=change(config.link, signing_key_file=None),
        process=change(config.process, checkpoint=False, state_directory=state_directory),
    )


def _result(
    options: DemoOptions, watch: DemoWatch, endpoint: CompanionEndpoint, truth: Point
) -> DemoResult:
    session = endpoint.session
    report = session.result
    estimate = session.estimate if report is None else report.estimate
    ended = watch.ended or "interrupted"
    if ended.startswith("the autopilot left"):
        ended += busy_hint(options.speed, watch.worst_gap_s)
    return DemoResult(
        is_localised=report is not None,
        estimate=estimate,
        ended=ended,
        time_s=watch.time_s if report is None else report.estimate.time_s,
        wall_s=watch.wall_s,
        error_m=None if estimate is None else math.dist(estimate.position_enu_m, truth),
    )


def busy_hint(speed: float, late_s: float) -> str:
    """What to do about a mode lost because a wake-up was `late_s` of flight late; or nothing."""
    if speed <= 1.0 or late_s <= LATE_S:
        return ""
    late = f"a control tick came {late_s:.1f} s late"
    return f"; this computer is too busy for --speed {speed:g} ({late}): try --speed 1"


def _conclude(
    options: DemoOptions,
    config: CompanionConfig,
    watch: DemoWatch,
    result: DemoResult,
    report: Mapping[str, Any],
) -> None:
    _say(_summary(result, report))
    if options.json is not None:
        write_json_atomic(options.json, _as_json(options, result, report))
        _say(f"result: {options.json}")
    if options.plot is not None and result.estimate is not None:
        _draw(options, config, watch, result.estimate, report)


def _summary(result: DemoResult, report: Mapping[str, Any]) -> str:
    if result.estimate is None:
        return f"NOT LOCALISED ({result.ended}): no measurement was used"
    head = "LOCALISED" if result.is_localised else f"NOT LOCALISED ({result.ended})"
    east, north = result.estimate.position_enu_m
    return (
        f"{head}: east {east:.2f} m, north {north:.2f} m, R95 {result.estimate.r95_m:.2f} m, "
        f"error against the truth {result.error_m:.2f} m\n"
        f"after {result.time_s:.1f} s and {report['distance_m']:.0f} m of flight, "
        f"{result.wall_s:.1f} s of real time"
    )


def _as_json(
    options: DemoOptions, result: DemoResult, report: Mapping[str, Any]
) -> dict[str, object]:
    estimate = result.estimate
    east_m, north_m = (None, None) if estimate is None else estimate.position_enu_m
    return {
        "seed": options.seed,
        "speed": options.speed,
        "scenario": report["scenario"],
        "state": "searching" if estimate is None else estimate.state.value,
        "localised": result.is_localised,
        "ended": result.ended,
        "final_error_m": result.error_m,
        "r95_m": None if estimate is None else estimate.r95_m,
        "east_m": east_m,
        "north_m": north_m,
        "range_offset_m": None if estimate is None else estimate.range_offset_m,
        "bearing_offset_rad": None if estimate is None else estimate.bearing_offset_rad,
        "time_s": result.time_s,
        "distance_m": report["distance_m"],
        "wall_s": result.wall_s,
        "setpoints": report["setpoints_received"],
    }


def _draw(
    options: DemoOptions,
    config: CompanionConfig,
    watch: DemoWatch,
    estimate: TargetEstimate,
    report: Mapping[str, Any],
) -> None:
    try:
        from companion.demo.track_plot import Obstacle, PlottedFlight, draw
    except ImportError:
        _say("no picture: pip install 'companion-guidance[demo]' brings matplotlib")
        return
    truth = _emitter_enu_m(report)
    error_m = math.dist(estimate.position_enu_m, truth)
    flight = PlottedFlight(
        track_enu_m=[(point[1], point[2]) for point in report["track"]],
        estimates=watch.estimates,
        crossings_enu_m=watch.crossings_enu_m,
        fence_enu_m=config.limits.fence_enu_m,
        obstacles=[
            Obstacle(obstacle["name"], obstacle["corners_enu_m"], obstacle["height_m"])
            for obstacle in report["obstacles"]
        ],
        truth_enu_m=truth,
        final=estimate,
        title=f"{report['scenario']}, seed {options.seed}: error {error_m:.2f} m",
    )
    assert options.plot is not None
    try:
        draw(options.plot, flight)
    except OSError as error:
        raise CompanionError(f"{options.plot}: cannot be written: {error.strerror}") from error
    _say(f"picture: {options.plot}")


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()
