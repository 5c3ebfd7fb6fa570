"""Flies the demonstration on the simulator and reports its result."""

from __future__ import annotations

import importlib.util
import json
import math
import os
import signal
import sys
import tempfile
import threading
import time
import webbrowser
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from companion.config.loader import CONFIG_FOLDERS
from companion.config.schema import CompanionConfig
from companion.domain import radii_text
from companion.errors import CompanionError, ConfigError, how_to_install
from companion.geometry.polygons import Point
from companion.guidance.commands import Severity
from companion.guidance.events import ProcessMessage
from companion.guidance.phases import Phase
from companion.io.child_processes import HOST, START_S, ChildProcess, Pacer, free_udp_port
from companion.io.files import check_writable, write_json_atomic
from companion.io.links.transports import FlightLink, UdpBind
from companion.link.endpoint import CompanionEndpoint
from companion.link.interface import LinkRole, LinkSpec
from companion.run import FlightOptions, FlightView, fly, is_handed_over

STOP_TIMEOUT_S = 30.0
"""Real time for its last report, which a busy computer delays."""


class SimulatorProcess(ChildProcess):
    """`sim-link`, which ends with this process; its output goes next to its report."""

    def __init__(
        self,
        report: Path,
        seed: int,
        clock: Pacer,
        scenario: Path | None,
        companion_port: int,
        autopilot: str | None,
    ) -> None:
        self._report = report
        arguments = [
            *("-m", "sim_link", "--stop-on-eof", "--quiet"),
            *("--seed", str(seed), "--speed", str(clock.speed), "--report", str(report)),
            *("--listen", f"{HOST}:{free_udp_port()}"),
            *("--send-to", f"{HOST}:{companion_port}"),
            *(() if scenario is None else ("--scenario", str(scenario))),
            *(() if autopilot is None else ("--autopilot", autopilot)),
        ]
        super().__init__("sim-link", arguments, report.with_suffix(".log"), clock.environment(0))

    def __enter__(self) -> SimulatorProcess:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop(STOP_TIMEOUT_S)

    def started_report(self) -> dict[str, Any]:
        """Return the report, with the truth, of a started simulator; else `CompanionError`."""
        deadline = time.monotonic() + START_S
        while not self._report.exists():
            if not self.is_alive or time.monotonic() > deadline:
                words = self.last_words.removeprefix("sim-link: ")
                raise CompanionError(f"the simulator did not start{words and ': '}{words}")
            time.sleep(0.02)
        return self.report()

    def report(self) -> dict[str, Any]:
        """Return the current report."""
        value: dict[str, Any] = json.loads(self._report.read_text(encoding="utf-8"))
        return value


FENCE_AROUND_AREA_M = 10.0
OBSTACLE_CLEARANCE_M = 5.0
"""Obstacles that end less than this below the search altitude are flown around."""
PICTURE_SUFFIXES = (".png", ".svg", ".pdf")
SILENCE_LIMIT_S = 10.0
"""Silence, in flight time and in real time, after which the demonstration ends."""
LATE_S = 0.5
"""Delay of a wake-up, in flight time, that can cost the autopilot's mode."""

MakeViews = Callable[[CompanionConfig, Point], list[FlightView]]
"""Makes the views of a flight, by its configuration and the emitter's true position."""


@dataclass(frozen=True, slots=True)
class DemoOptions:
    """Options of the command line."""

    seed: int
    speed: float
    scenario: Path | None
    autopilot: str | None
    """px4 or ardupilot; None: the scenario's."""
    json: Path | None
    plot: Path | None


def check_simulator() -> None:
    """Check that the simulator is installed; a `CompanionError` has the command to install it."""
    if importlib.util.find_spec("sim_link") is None:
        command = how_to_install("./sim_link")
        raise CompanionError(f"the simulator is not installed; in the checkout: {command}")


def scenario_named(path: Path) -> tuple[Path, Path | None]:
    """Return the file of a scenario, and the preset of its name if it was given by that.

    A name is the path below `configs/scenarios` without its ending, of the working directory or of
    the checkout: `field/phone_ftm`. Raises `ConfigError` if there is neither.
    """
    if path.exists() or path.suffix or path.is_absolute():
        return path, None
    for configs in CONFIG_FOLDERS:
        file, preset = (configs / kind / f"{path}.yaml" for kind in ("scenarios", "companion"))
        if file.is_file():
            return file, preset if preset.is_file() else None
    below = [
        (file, configs / "scenarios")
        for configs in CONFIG_FOLDERS
        for file in configs.rglob("*.yaml")
    ]
    known = {str(file.relative_to(at).with_suffix("")) for file, at in below if at in file.parents}
    there = f"; there are {', '.join(sorted(known))}" if known else ""
    raise ConfigError(f"--scenario {path}: no such file, and no scenario of this name{there}")


class DemoWatch(FlightView):
    """Ends the flight once there is a reason, and keeps the data for the plot."""

    def __init__(self, simulator: SimulatorProcess, limit_s: float, clock: Pacer) -> None:
        self._simulator = simulator
        self._clock, self._pace = clock, clock.pace
        self._limit_s = limit_s
        self._began_wall_s: float | None = None
        self.ended = ""
        """Reason for the end; empty: interrupted by the user."""
        self.time_s = 0.0
        """Time of the companion at the last wake-up before the end."""
        self.worst_gap_s = 0.0
        """Largest flight time between two wake-ups."""
        self.estimates: list[tuple[float, float, float, float]] = []
        """Estimates so far: time_s, east_m, north_m and r95_m of each."""
        self.crossings_enu_m: list[Point] = []

    @property
    def wall_s(self) -> float:
        """Real time since the flight began."""
        return 0.0 if self._began_wall_s is None else time.monotonic() - self._began_wall_s

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Keep the estimates, and the crossing points chosen."""
        position, r95_m = fields.get("position_enu_m"), fields.get("r95_m")
        if kind == "estimate" and isinstance(position, tuple) and isinstance(r95_m, float):
            self.estimates.append((now_s, position[0], position[1], r95_m))
        elif kind == "waypoint" and isinstance(position, tuple):
            self.crossings_enu_m.append((position[0], position[1]))

    def update(self, endpoint: CompanionEndpoint, now_s: float) -> None:
        """Request the end, as Ctrl-C does, if there is a reason."""
        if self.ended:
            return
        if self._began_wall_s is None:
            self._began_wall_s = time.monotonic()
        elif endpoint.binding.is_bound:
            self.worst_gap_s = max(self.worst_gap_s, now_s - self.time_s)
        self.time_s = now_s
        if self._clock.pace != self._pace:
            text = f"this computer is too busy for {self._pace}: continuing at {self._clock.pace}"
            self._pace = self._clock.pace
            endpoint.handle_event(ProcessMessage(now_s, Severity.NOTICE, text))
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
        if endpoint.binding.heard_s is None and min(self.wall_s, now_s) > SILENCE_LIMIT_S:
            return "nothing heard from the simulator; is the loopback interface up?"
        return None


def run_demo(
    options: DemoOptions,
    config: CompanionConfig,
    make_views: MakeViews,
    at_end: Callable[[Path], None] | None = None,
) -> bool:
    """Fly, print the result, write the outputs; True: found, and nothing of the log is lost."""
    # refuse outputs before the flight that could not be written after it
    for path in (options.json, options.plot):
        if path is not None:
            check_writable(path)
    if options.plot is not None and options.plot.suffix.lower() not in PICTURE_SUFFIXES:
        known = ", ".join(PICTURE_SUFFIXES)
        raise ConfigError(f"--plot {options.plot}: the name must end in {known}")
    port = free_udp_port()
    with tempfile.TemporaryDirectory() as temporary:
        report = Path(temporary) / "sim-link.json"
        clock = Pacer(Path(temporary) / "clock", options.speed)
        simulator = SimulatorProcess(
            report, options.seed, clock, options.scenario, port, options.autopilot
        )
        with simulator:
            truth = simulator.started_report()
            config = _demo_config(config, truth, temporary)
            watch = DemoWatch(simulator, float(truth["time_limit_s"]), clock)
            links = [FlightLink(UdpBind(HOST, port), LinkSpec(LinkRole.VEHICLE))]
            views = [watch, *make_views(config, _emitter_enu_m(truth))]
            flight_options = FlightOptions(views=views, at_end=at_end)
            end = fly(config, links, clock, flight_options)
            simulator.stop(STOP_TIMEOUT_S)  # it writes its report first
            result = DemoResult(options, watch, end.endpoint, simulator.report())
            _say(result.summary)
            if options.json is not None:
                write_json_atomic(options.json, result.as_json())
                _say(f"result: {options.json}")
            if options.plot is not None:
                result.draw(options.plot, config)
    return result.is_localised and end.is_log_whole


def _emitter_enu_m(report: Mapping[str, Any]) -> Point:
    east_m, north_m = report["emitter"]["enu_m"][:2]
    return (float(east_m), float(north_m))


def _demo_config(
    config: CompanionConfig, truth: Mapping[str, Any], state_directory: str
) -> CompanionConfig:
    """Return the configuration with automatic launch, fence and obstacles, without a key."""
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
        process=change(config.process, resume_max_age_s=None, state_directory=state_directory),
    )


def busy_hint(late_s: float) -> str:
    """Return the remedy for a mode lost by a wake-up `late_s` of flight late; empty: in time."""
    if late_s <= LATE_S:
        return ""
    late = f"a control tick was {late_s:.1f} s late"
    return f"; this computer is too busy ({late}): end other programs and try again"


class DemoResult:
    """Result of the flight and its summary; the `report` is the simulator's."""

    def __init__(
        self,
        options: DemoOptions,
        watch: DemoWatch,
        endpoint: CompanionEndpoint,
        report: Mapping[str, Any],
    ) -> None:
        session = endpoint.session
        found = session.result
        self._options, self._watch, self._report = options, watch, report
        self.is_localised = found is not None
        self.estimate = session.estimate if found is None else found.estimate
        self.time_s = watch.time_s if found is None else found.estimate.time_s
        """Time of the companion at the report or at the end."""
        self.wall_s = watch.wall_s
        self.ended = watch.ended or "interrupted"
        if self.ended.startswith("the autopilot left"):
            self.ended += busy_hint(watch.worst_gap_s)
        self.truth_enu_m = _emitter_enu_m(report)
        self.error_m = None
        if self.estimate is not None:
            self.error_m = math.dist(self.estimate.position_enu_m, self.truth_enu_m)

    @property
    def summary(self) -> str:
        """Result in two lines."""
        if self.estimate is None:
            return f"NOT LOCALISED ({self.ended}): no measurement was used"
        head = "LOCALISED" if self.is_localised else f"NOT LOCALISED ({self.ended})"
        east, north = self.estimate.position_enu_m
        found = self.estimate
        radii = radii_text(found.absolute_r95_m, found.r95_m, found.own, decimals=2)
        return (
            f"{head}: east {east:.2f} m, north {north:.2f} m, {radii}, "
            f"error against the truth {self.error_m:.2f} m\n"
            f"after {self.time_s:.1f} s and {self._report['distance_m']:.0f} m of flight, "
            f"{self.wall_s:.1f} s of real time"
        )

    def as_json(self) -> dict[str, object]:
        """Return plain values for `--json`."""
        estimate = self.estimate
        east_m, north_m = (None, None) if estimate is None else estimate.position_enu_m
        return {
            "seed": self._options.seed,
            "speed": self._options.speed,
            "scenario": self._report["scenario"],
            "state": "searching" if estimate is None else estimate.state.value,
            "localised": self.is_localised,
            "ended": self.ended,
            "final_error_m": self.error_m,
            "r95_m": getattr(estimate, "r95_m", None),
            "absolute_r95_m": getattr(estimate, "absolute_r95_m", None),
            "east_m": east_m,
            "north_m": north_m,
            "range_offset_m": getattr(estimate, "range_offset_m", None),
            "bearing_offset_rad": getattr(estimate, "bearing_offset_rad", None),
            "time_s": self.time_s,
            "distance_m": self._report["distance_m"],
            "wall_s": self.wall_s,
            "setpoints": self._report["setpoints_received"],
        }

    def draw(self, path: Path, config: CompanionConfig) -> None:
        """Draw the picture for `--plot`, if there is an estimate and matplotlib."""
        if self.estimate is None:
            return
        try:
            from companion.demo.track_plot import Obstacle, PlottedFlight, draw
        except ImportError:
            _say(f"no picture without matplotlib: {how_to_install('matplotlib')}")
            return
        report = self._report
        flight = PlottedFlight(
            track_enu_m=[(point[1], point[2]) for point in report["track"]],
            estimates=self._watch.estimates,
            crossings_enu_m=self._watch.crossings_enu_m,
            fence_enu_m=config.limits.fence_enu_m,
            obstacles=[
                Obstacle(obstacle["name"], obstacle["corners_enu_m"], obstacle["height_m"])
                for obstacle in report["obstacles"]
            ],
            truth_enu_m=self.truth_enu_m,
            final=self.estimate,
            title=f"{report['scenario']}, seed {self._options.seed}: error {self.error_m:.2f} m",
        )
        try:
            draw(path, flight)
        except OSError as error:
            raise CompanionError(f"{path}: cannot be written: {error.strerror}") from error
        _say(f"picture: {path}")


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


SCREENS = ("BROWSER", "DISPLAY", "WAYLAND_DISPLAY")
"""One of these is set where a browser can be seen; over SSH and in services none is."""


def open_page(url: str) -> bool:
    """Open a page without blocking the flight; return False without a screen."""
    if sys.platform.startswith("linux") and not any(os.environ.get(name) for name in SCREENS):
        return False
    threading.Thread(target=_open, args=(url,), name="browser", daemon=True).start()
    return True


def _open(url: str) -> None:
    with suppress(webbrowser.Error, OSError):
        webbrowser.open(url)
