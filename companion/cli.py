"""The `companion` command: arguments, lines for people and exit codes."""

from __future__ import annotations

import argparse
import io
import json
import logging
import os
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from companion.arguments import argument_parser, check_place_of_options
from companion.config.schema import (
    CompanionConfig,
    load_config,
    with_fence,
    with_radios,
    with_signing_key,
)
from companion.errors import CompanionError, ConfigError, how_to_install
from companion.flight_setup import flight_links, radio_links, with_kept_offsets
from companion.io.child_processes import clock_of
from companion.io.files import check_writable, write_json_atomic
from companion.io.links.link import NOTICE
from companion.io.links.transports import check_exposure, parse_flight_link
from companion.io.radio_recording import is_radio_recording
from companion.link.interface import LinkRole
from companion.replay.flight_replay import FlightReplay, Pace, replay_flight, replay_on_map
from companion.replay.walk_replay import (
    WalkAccuracy,
    explanation,
    replay_walk,
    stated_accuracy,
    table,
)
from companion.run import FlightOptions, FlightView, compile_kernels, fly
from companion.view.console import ConsoleHandler, PlainView
from companion.view.cot import CotView, cot_address
from companion.web.live_map import WebView
from companion.web.settings import WebSettings, check_tiles, web_settings

EXIT_FAILED = 1
EXIT_BAD_INPUT = 2
EXIT_NOT_FOUND = 3


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command, and return the exit code.

    0 is success, 1 a failed run, 2 bad input or a link that does not open, 3 a search that came to
    its end with nothing heard.
    """
    try:
        try:
            return _run(argv)
        finally:  # log lines come before the error below
            for handler in logging.getLogger("companion").handlers:
                handler.close()
    except CompanionError as error:
        for line in str(error).splitlines():
            print(f"companion: {line}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print("companion: interrupted", file=sys.stderr)
        return EXIT_FAILED


def _run(argv: Sequence[str] | None) -> int:
    arguments = argument_parser().parse_args(argv)
    _set_up_logging(quiet=arguments.quiet)
    check_place_of_options(arguments)
    commands = {
        "demo": _demo,
        "replay": _replay,
        "report": _report,
        "area": _area,
        "doctor": _doctor,
        "radio": _radio,
        "config": _config,
        "setup": _setup,
        "tiles": _tiles,
        "warm-up": _warm_up,
    }
    return commands.get(arguments.command, _fly)(arguments)


def _web_settings(arguments: argparse.Namespace) -> WebSettings | None:
    """Return the map's settings for a flight, for the demo, which has buttons, or for a replay."""
    is_flight = arguments.command is None
    web = arguments.fly_web if is_flight else arguments.web
    tiles = arguments.fly_web_tiles if is_flight else arguments.web_tiles
    if web is None:
        options = {
            "control": arguments.web_control,
            "token": arguments.web_token,
            "open": arguments.web_open,
            "tiles": tiles,
        }
        given = [name for name, value in options.items() if value]
        if given:
            raise ConfigError(f"--web-{given[0]}: there is no map without --web PORT")
        return None
    return web_settings(
        web,
        token=arguments.web_token,
        is_control_on=arguments.web_control or arguments.command == "demo",
        is_view_open=arguments.web_open,
        tiles=tiles,
    )


def _set_up_logging(*, quiet: bool, stream: io.TextIOBase | None = None) -> None:
    """Configure our own loggers only: libraries stay silent."""
    logger = logging.getLogger("companion")
    handler = ConsoleHandler(sys.stderr if stream is None else stream)
    handler.setFormatter(logging.Formatter("%(message)s"))
    logger.handlers = [handler]
    logger.setLevel(NOTICE if quiet else logging.INFO)
    logger.propagate = False


def _fly(arguments: argparse.Namespace) -> int:
    if arguments.connect is None:
        raise ConfigError("say where the autopilot is: --connect udp:127.0.0.1:14540, or try demo")
    config = _flight_config(arguments)
    settings = _web_settings(arguments)
    links = flight_links(arguments.connect, arguments.ranging, config.radios, arguments.gcs)
    if not arguments.insecure:
        check_exposure(
            links,
            has_key=config.link.signing_key_file is not None,
            unsigned_ranging=config.link.unsigned_ranging,
        )
    views: list[FlightView] = []
    if arguments.cot is not None:
        views.append(CotView(cot_address(arguments.cot)))
    if settings is not None:
        views.append(_web_view(settings, config))
    if not arguments.quiet:
        views.append(_console_view())
    options = FlightOptions(
        once=arguments.once,
        is_fresh=arguments.fresh,
        views=views,
        at_end=partial(_report_flight, arguments.fly_web_tiles),
    )
    endpoint = fly(config, links, clock_of(arguments.fly_speed or 1.0), options)
    if arguments.once and endpoint.session.is_search_over and endpoint.session.result is None:
        print("companion: the search is over, nothing heard", file=sys.stderr)
        return EXIT_NOT_FOUND
    if arguments.once and endpoint.session.result is None:
        print("companion: ended before the target was localised", file=sys.stderr)
        return EXIT_FAILED
    return 0


def _flight_config(arguments: argparse.Namespace) -> CompanionConfig:
    """Return the file's configuration, with the command line's changes."""
    config = load_config(arguments.fly_config)
    if arguments.fence is not None:
        config = with_fence(config, arguments.fence)
    if arguments.signing_key is not None:
        config = with_signing_key(config, arguments.signing_key)
    return with_kept_offsets(with_radios(config, arguments.radio))


def _web_view(
    settings: WebSettings,
    config: CompanionConfig,
    truth_enu_m: tuple[float, float] | None = None,
    *,
    outlives: bool = False,
) -> WebView:
    page = WebView(settings, config, truth_enu_m, outlives=outlives)
    print(f"live map: {page.url}", file=sys.stderr)
    return page


def _console_view() -> FlightView:
    if not sys.stderr.isatty() or os.environ.get("TERM", "dumb") == "dumb":
        return PlainView()
    try:
        from companion.view.terminal import TerminalView
    except ImportError:
        print(f"for the live screen: {how_to_install('rich')}", file=sys.stderr)
        return PlainView()
    view = TerminalView()
    _set_up_logging(quiet=False, stream=view.stream)
    return view


def _radio(arguments: argparse.Namespace) -> int:
    from companion.radio_tools.radio_commands import run

    return run(arguments)


def _area(arguments: argparse.Namespace) -> int:
    from companion.report.searched_area import run

    return run(arguments)


def _config(arguments: argparse.Namespace) -> int:
    from companion.setup_tools.config_commands import run

    return run(arguments)


def _setup(arguments: argparse.Namespace) -> int:
    from companion.setup_tools.setup_commands import run

    return run(arguments)


def _tiles(arguments: argparse.Namespace) -> int:
    from companion.setup_tools.tile_commands import run

    return run(arguments)


def _warm_up(arguments: argparse.Namespace) -> int:
    load_config(arguments.config)
    try:
        print(compile_kernels())
    except CompanionError as error:
        print(f"companion: {error}", file=sys.stderr)
        print("companion: kernels run as plain Python, which suffices in flight", file=sys.stderr)
        return EXIT_FAILED
    return 0


def _report(arguments: argparse.Namespace) -> int:
    from companion.report.page import write_report

    if arguments.web_tiles is not None:
        check_tiles(arguments.web_tiles)
    print(write_report(arguments.flight, arguments.output, arguments.web_tiles, _warn))
    return 0


def _warn(text: str) -> None:
    print(f"companion: {text}", file=sys.stderr)


def _report_flight(tiles: Path | None, directory: Path) -> None:
    """Make the report of a flight; of a long one only on request, because the end must be quick."""
    from companion.report.page import is_quick

    if is_quick(directory):
        _write_report(directory, tiles)
    else:
        print(f"companion: make the report with: companion report {directory}", file=sys.stderr)


def _write_report(directory: Path, tiles: Path | None) -> Path | None:
    from companion.report.page import write_report  # load jinja2 only for a report

    try:
        path = write_report(directory, tiles=tiles)
    except CompanionError as error:
        print(f"companion: no report: {error}", file=sys.stderr)
        return None
    logging.getLogger("companion").info("report: %s", path)
    return path


def _replay(arguments: argparse.Namespace) -> int:
    config = None if arguments.config is None else load_config(arguments.config)
    if arguments.json is not None:
        check_writable(arguments.json)
    settings = _web_settings(arguments)
    if arguments.file.suffix.lower() == ".csv":
        if arguments.speed is not None:
            raise ConfigError("--speed: a walk is replayed as fast as it goes; leave it out")
        if settings is not None:
            raise ConfigError("--web: a walk has no map; leave it out")
        return _replay_walk(arguments, config or CompanionConfig())
    if arguments.own_sigma is not None or arguments.explain:
        raise ConfigError("--own-sigma, --explain: only of a recorded walk (.csv); leave them out")
    if is_radio_recording(arguments.file):
        return _replay_recording(arguments, config or CompanionConfig())

    def report(replay: FlightReplay) -> None:
        """Print the comparison, and write the figures if requested."""
        print(replay.table())
        print(replay.verdict, flush=True)
        if arguments.json is not None:
            value = {**replay.as_json(), "exact": replay.is_exact}
            write_json_atomic(arguments.json, value)

    if settings is not None:
        speed = arguments.speed or 1.0
        say = partial(print, flush=True)  # a script may wait for the line
        replay = replay_on_map(arguments.file, config, say, settings, speed, report)
    else:
        pace = None if arguments.speed is None else Pace(arguments.speed)
        replay = replay_flight(arguments.file, config, print, pace)
        report(replay)
    return EXIT_FAILED if replay.is_failed else 0


def _replay_recording(arguments: argparse.Namespace, config: CompanionConfig) -> int:
    from companion.replay.radio_replay import replay_recording

    if arguments.speed is not None or arguments.web is not None:
        raise ConfigError("--speed, --web: a radio recording is replayed at once; leave them out")
    replay = replay_recording(arguments.file, config)
    print("\n".join(replay.radios))
    if replay.targets:
        print(table(replay.targets, config.estimation.localised_r95_m))
    if arguments.json is not None:
        value = {"file": arguments.file.name, "targets": [r.as_json() for r in replay.targets]}
        write_json_atomic(arguments.json, value)
    return 0


def _replay_walk(arguments: argparse.Namespace, config: CompanionConfig) -> int:
    def progress(rows: int) -> None:
        """Show the number of rows on a terminal."""
        if sys.stderr.isatty():
            print(f"\r{rows} rows", end="", file=sys.stderr, flush=True)

    beside = arguments.file.with_suffix(".json")
    is_beside = arguments.json is not None and arguments.json.resolve() == beside.resolve()
    if is_beside and stated_accuracy(arguments.file) != WalkAccuracy():
        raise ConfigError(f"--json: {beside} describes the walk; choose another file")
    results = replay_walk(arguments.file, config.tracking, progress, arguments.own_sigma)
    if sys.stderr.isatty():
        print("\r", end="", file=sys.stderr)
    print(table(results, config.estimation.localised_r95_m))
    if arguments.explain:
        print(explanation(results))
    if not config.tracking.is_range_calibrated:
        print("uncalibrated: range offset unknown, so nothing is localised; set offset_steps")
    if arguments.json is not None:
        value = {"file": arguments.file.name, "targets": [r.as_json() for r in results]}
        write_json_atomic(arguments.json, value)
    return 0


def _demo(arguments: argparse.Namespace) -> int:
    from companion.demo.runner import (
        DemoOptions,
        check_simulator,
        open_page,
        run_demo,
        scenario_named,
    )

    check_simulator()
    scenario, preset = None, None
    if arguments.scenario is not None:
        scenario, preset = scenario_named(arguments.scenario)
    options = DemoOptions(
        seed=arguments.seed,
        speed=arguments.speed,
        scenario=scenario,
        autopilot=arguments.autopilot,
        json=arguments.json,
        plot=None if arguments.no_plot else arguments.plot,
    )
    settings = _web_settings(arguments)
    pages: list[WebView] = []

    def make_views(config: CompanionConfig, truth_enu_m: tuple[float, float]) -> list[FlightView]:
        """Return the screen, and the map with the emitter's true position for comparison."""
        if settings is not None:
            pages.append(_web_view(settings, config, truth_enu_m, outlives=True))
            if not arguments.no_browser:
                open_page(pages[0].url)
        return [*pages, _console_view()]

    def report(directory: Path) -> None:
        """Make the report of any flight: no vehicle waits for the end."""
        path = _write_report(directory, arguments.web_tiles)
        if path is not None and settings is not None and not arguments.no_browser:
            open_page(path.resolve().as_uri())

    config = load_config(arguments.config or preset)
    try:
        is_found = run_demo(options, config, make_views, report)
        for page in pages:
            if page.process.viewers:
                print(
                    "live map: stays until its browser is closed; Ctrl-C ends it", file=sys.stderr
                )
            page.await_left()
    finally:
        for page in pages:
            page.process.close()
    return 0 if is_found else EXIT_FAILED


def _doctor(arguments: argparse.Namespace) -> int:
    from companion.doctor.examination import exit_code, run_doctor
    from companion.doctor.findings import as_json, as_lines

    config = load_config(arguments.config)
    if arguments.key is not None:
        config = with_signing_key(config, arguments.key)
    config = with_kept_offsets(with_radios(config, arguments.radios))
    link = parse_flight_link(arguments.link, LinkRole.VEHICLE)
    if not arguments.is_insecure:
        has_key = config.link.signing_key_file is not None
        check_exposure([link, *radio_links(config.radios)], has_key=has_key)
    findings = run_doctor(config, link.transport, arguments.seconds)
    if arguments.json:
        print(json.dumps(as_json(findings), indent=2))
    else:
        print("\n".join(as_lines(findings)))
    return exit_code(findings)
