"""Runs the demonstration and says how well it went."""

from __future__ import annotations

import math
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from companion.config.schema import CompanionConfig, load_config
from companion.demo.screens import LiveScreen, PlainLines, RecordingJournal, best_screen, say
from companion.demo.simulator_process import HOST, SimulatorProcess, free_udp_port
from companion.domain import TargetEstimate
from companion.errors import CompanionError, ConfigError
from companion.flight_setup import FlightFacts, build_endpoint, write_facts
from companion.guidance.authority.state_machine import Phase
from companion.io.files import check_writable, new_flight_directory, write_json_atomic
from companion.io.links.specs import UdpBind
from companion.io.shell import Clock, Shell
from companion.kernel import IS_COMPILED
from companion.link.endpoint import CompanionEndpoint
from companion.run import is_handed_over, prepare
from companion.web.live_map import WebView
from companion.web.settings import WebSettings

FENCE_AROUND_AREA_M = 10.0
OBSTACLE_CLEARANCE_M = 5.0
"""Obstacles that end less than this below the search altitude are flown around."""
PICTURE_SUFFIXES = (".png", ".svg", ".pdf")
SILENCE_LIMIT_S = 10.0
"""Real seconds after which a simulator that is not heard is given up."""
LATE_S = 0.5
"""Of the flight: a control tick later than this can cost the autopilot's mode."""


@dataclass(frozen=True, slots=True)
class DemoOptions:
    """What the command line asked for."""

    seed: int
    speed: float
    scenario: Path | None
    autopilot: str | None
    """px4 or ardupilot; None: the scenario's."""
    config: Path | None
    json: Path | None
    plot: Path | None
    web: WebSettings | None = None
    """Where to serve the live map; None: nowhere."""


@dataclass(frozen=True, slots=True)
class DemoResult:
    """How the flight ended."""

    is_localised: bool
    estimate: TargetEstimate | None
    ended: str
    time_s: float
    """Of the companion, at the report or at the end."""
    wall_s: float
    """Real time that the flight took."""


def run_demo(options: DemoOptions) -> bool:
    """Fly it, print how it went, write what was asked for; whether the target was found.

    Raises:
        CompanionError: Bad input, or the simulator does not start.
    """
    config = load_config(options.config)
    _check_outputs(options)
    if IS_COMPILED:
        say("compiling kernels: half a minute the first time, then a second")
    prepare(config)
    show = best_screen()
    started_unix_s = time.time()
    directory = new_flight_directory(Path(config.log.directory), started_unix_s)
    port = free_udp_port()
    with tempfile.TemporaryDirectory() as temporary:
        report = Path(temporary) / "sim-link.json"
        simulator = SimulatorProcess(
            report, options.seed, options.speed, options.scenario, port, options.autopilot
        )
        with simulator:
            truth = simulator.started_report()
            config = _demo_config(config, truth)
            facts = FlightFacts(started_unix_s=started_unix_s, links=1, config=config)
            write_facts(directory, facts)
            journal = RecordingJournal(directory, started_unix_s, config.log.max_bytes)
            page = _open_page(options.web, config, truth)
            try:
                result = _fly(config, options, journal, simulator, port, truth, show, page)
            finally:
                journal.close()
                if page is not None:
                    page.close()
            simulator.stop()
            _conclude(options, config, journal, result, simulator.report())
    return result.is_localised


def _check_outputs(options: DemoOptions) -> None:
    """Refuse before the flight what could not be written after it."""
    for path in (options.json, options.plot):
        if path is not None:
            check_writable(path)
    if options.plot is not None and options.plot.suffix.lower() not in PICTURE_SUFFIXES:
        known = ", ".join(PICTURE_SUFFIXES)
        raise ConfigError(f"--plot {options.plot}: the name must end in {known}")


def _demo_config(config: CompanionConfig, truth: dict[str, Any]) -> CompanionConfig:
    """The configuration, engaging by itself, fenced in around the scenario's area.

    It keeps out of the obstacles that reach its altitude, as an operator would tell it to.

    Raises:
        ConfigError: The fence and the obstacles leave nothing to fly in.
    """
    mission = msgspec.structs.replace(config.mission, engage="auto")
    east, north = (float(size) for size in truth["area_m"])
    low, margin = -FENCE_AROUND_AREA_M, FENCE_AROUND_AREA_M
    fence = (
        (low, low),
        (east + margin, low),
        (east + margin, north + margin),
        (low, north + margin),
    )
    keep_out = tuple(
        tuple((float(east), float(north)) for east, north in obstacle["corners_enu_m"])
        for obstacle in truth["obstacles"]
        if obstacle["height_m"] is None
        or obstacle["height_m"] > config.mission.altitude_m - OBSTACLE_CLEARANCE_M
    )
    try:
        limits = msgspec.structs.replace(
            config.limits,
            fence_enu_m=fence,
            keep_out_enu_m=(*config.limits.keep_out_enu_m, *keep_out),
        )
    except ValueError as error:
        raise ConfigError(f"scenario {truth['scenario']}: {error}") from error
    return msgspec.structs.replace(config, mission=mission, limits=limits)


def _fly(
    config: CompanionConfig,
    options: DemoOptions,
    journal: RecordingJournal,
    simulator: SimulatorProcess,
    port: int,
    truth: dict[str, Any],
    view: LiveScreen | PlainLines,
    page: WebView | None,
) -> DemoResult:
    listens = journal if page is None else page.listen(journal)
    endpoint = build_endpoint(config, listens, recorder=journal.inputs)
    journal.is_quiet = isinstance(view, LiveScreen)
    limit_s = float(truth["time_limit_s"])
    ended: list[tuple[str, float]] = []
    latest = [0.0]

    def on_wakeup(now_s: float) -> None:
        """Show the flight, and end it once there is a reason."""
        view(endpoint, journal, now_s)
        if page is not None:
            page.update(endpoint, now_s)
        latest[0] = now_s
        reason = _end_reason(endpoint, simulator, now_s, limit_s)
        if endpoint.binding.heard_s is None and time.monotonic() - started > SILENCE_LIMIT_S:
            reason = "nothing heard from the simulator; is the loopback interface up?"
        if reason is not None and not ended:
            ended.append((reason, now_s))
            shell.request_stop()

    shell = Shell(endpoint, [UdpBind(HOST, port)], Clock(options.speed), on_wakeup)
    started = time.monotonic()
    with view:
        shell.run_blocking()
    result = endpoint.session.result
    reason, now_s = ended[0] if ended else ("interrupted", latest[0])
    if endpoint.session.phase is Phase.YIELD:
        reason += busy_hint(options.speed, shell.timing.worst_late_s)
    return DemoResult(
        is_localised=result is not None,
        estimate=endpoint.session.estimate if result is None else result.estimate,
        ended=reason,
        time_s=now_s if result is None else result.estimate.time_s,
        wall_s=time.monotonic() - started,
    )


def busy_hint(speed: float, worst_late_s: float) -> str:
    """What to do about a mode that was lost, where the computer was too busy; or nothing.

    Args:
        speed: How much faster than real time the flight was.
        worst_late_s: How late a control tick came at most, in real seconds.
    """
    late_s = worst_late_s * speed
    if speed <= 1.0 or late_s <= LATE_S:
        return ""
    late = f"a control tick came {late_s:.1f} s late"
    return f"; this computer is too busy for --speed {speed:g} ({late}): try --speed 1"


def _open_page(
    settings: WebSettings | None, config: CompanionConfig, truth: dict[str, Any]
) -> WebView | None:
    """The live map, with the emitter's true place for comparison.

    Raises:
        CompanionError: The port is taken, or the extra `web` is not installed.
    """
    if settings is None:
        return None
    east, north = truth["emitter"]["enu_m"][:2]
    page = WebView(settings, config, (float(east), float(north)))
    say(f"live map: {page.url}")
    return page


def _end_reason(
    endpoint: CompanionEndpoint, simulator: SimulatorProcess, now_s: float, limit_s: float
) -> str | None:
    if is_handed_over(endpoint):
        return "localised"
    if endpoint.session.phase is Phase.YIELD:
        return f"the autopilot left {endpoint.session.vehicle.guided_name}"
    if now_s > limit_s:
        return f"time limit of {limit_s:g} s"
    if not simulator.is_alive:
        return "the simulator ended"
    return None


def _conclude(
    options: DemoOptions,
    config: CompanionConfig,
    journal: RecordingJournal,
    result: DemoResult,
    report: dict[str, Any],
) -> None:
    truth = (float(report["emitter"]["enu_m"][0]), float(report["emitter"]["enu_m"][1]))
    estimate = result.estimate
    error_m = None if estimate is None else math.dist(estimate.position_enu_m, truth)
    say(_summary(result, error_m, report))
    say(f"flight log: {journal.directory}")
    if options.json is not None:
        write_json_atomic(options.json, _as_json(options, result, error_m, report))
        say(f"result: {options.json}")
    if options.plot is not None and estimate is not None:
        _draw(options.plot, options, config, journal, estimate, truth, report)


def _summary(result: DemoResult, error_m: float | None, report: dict[str, Any]) -> str:
    if result.estimate is None or error_m is None:
        return f"NOT LOCALISED ({result.ended}): no measurement was used"
    head = "LOCALISED" if result.is_localised else f"NOT LOCALISED ({result.ended})"
    east, north = result.estimate.position_enu_m
    return (
        f"{head}: east {east:.2f} m, north {north:.2f} m, R95 {result.estimate.r95_m:.2f} m, "
        f"error against the truth {error_m:.2f} m\n"
        f"after {result.time_s:.1f} s and {report['distance_m']:.0f} m of flight, "
        f"{result.wall_s:.1f} s of real time"
    )


def _as_json(
    options: DemoOptions, result: DemoResult, error_m: float | None, report: dict[str, Any]
) -> dict[str, object]:
    estimate = result.estimate
    return {
        "seed": options.seed,
        "speed": options.speed,
        "scenario": report["scenario"],
        "state": "searching" if estimate is None else estimate.state.value,
        "localised": result.is_localised,
        "ended": result.ended,
        "final_error_m": error_m,
        "r95_m": None if estimate is None else estimate.r95_m,
        "east_m": None if estimate is None else estimate.position_enu_m[0],
        "north_m": None if estimate is None else estimate.position_enu_m[1],
        "range_offset_m": None if estimate is None else estimate.range_offset_m,
        "bearing_offset_rad": None if estimate is None else estimate.bearing_offset_rad,
        "time_s": result.time_s,
        "distance_m": report["distance_m"],
        "wall_s": result.wall_s,
        "setpoints": report["setpoints_received"],
    }


def _draw(
    path: Path,
    options: DemoOptions,
    config: CompanionConfig,
    journal: RecordingJournal,
    estimate: TargetEstimate,
    truth: tuple[float, float],
    report: dict[str, Any],
) -> None:
    try:
        from companion.demo.track_plot import Obstacle, PlottedFlight, draw
    except ImportError:
        say("no picture: pip install 'companion-guidance[demo]' brings matplotlib")
        return
    flight = PlottedFlight(
        track_enu_m=[(point[1], point[2]) for point in report["track"]],
        estimates_enu_m=[(e, n) for _, e, n, _ in journal.estimates],
        r95=[(t, r95_m) for t, _, _, r95_m in journal.estimates],
        errors=[(t, math.dist((e, n), truth)) for t, e, n, _ in journal.estimates],
        crossings_enu_m=[(e, n) for _, e, n in journal.crossings],
        fence_enu_m=config.limits.fence_enu_m,
        obstacles=[
            Obstacle(obstacle["name"], obstacle["corners_enu_m"], obstacle["height_m"])
            for obstacle in report["obstacles"]
        ],
        truth_enu_m=truth,
        final=estimate,
        title=f"{report['scenario']}, seed {options.seed}: "
        f"error {math.dist(estimate.position_enu_m, truth):.2f} m",
    )
    try:
        draw(path, flight)
    except OSError as error:
        raise CompanionError(f"{path}: cannot be written: {error.strerror}") from error
    say(f"picture: {path}")
