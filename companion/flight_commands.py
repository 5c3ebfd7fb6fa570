"""A flight, and the demo of one, by the options of the command line."""

from __future__ import annotations

import argparse
import logging
import os
import shlex
import sys
from functools import partial
from pathlib import Path

from companion.config.schema import (
    CompanionConfig,
    load_config,
    with_fence,
    with_radios,
    with_signing_key,
)
from companion.errors import (
    EXIT_FAILED,
    EXIT_NOT_FOUND,
    CompanionError,
    ConfigError,
    how_to_install,
)
from companion.flight_setup import flight_links, with_kept_offsets
from companion.io.child_processes import clock_of
from companion.io.links.transports import check_exposure
from companion.run import FlightOptions, FlightView, compile_kernels, fly
from companion.view.cot import CotView, cot_address
from companion.view.log_lines import set_up_logging
from companion.view.snapshot import PlainView
from companion.web.live_map import WebView
from companion.web.settings import WebSettings, requested_settings


def fly_vehicle(arguments: argparse.Namespace) -> int:
    """Fly the vehicle of the command line, and return the exit code."""
    if arguments.connect is None:
        raise ConfigError(
            "specify the link to the autopilot: --connect udp:127.0.0.1:14540, or try demo"
        )
    config = _flight_config(arguments)
    settings = requested_settings(arguments)
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
        views.append(_open_map(settings, config))
    if not arguments.quiet:
        views.append(_console_view())
    options = FlightOptions(
        once=arguments.once,
        is_fresh=arguments.fresh,
        views=views,
        at_end=partial(_report_flight, arguments.fly_web_tiles),
    )
    end = fly(config, links, clock_of(arguments.fly_speed or 1.0), options)
    endpoint = end.endpoint
    if arguments.once and endpoint.session.is_search_over and endpoint.session.result is None:
        print("companion: the search is over, nothing heard", file=sys.stderr)
        return EXIT_NOT_FOUND
    if arguments.once and endpoint.session.result is None:
        print("companion: ended before the target was localised", file=sys.stderr)
        return EXIT_FAILED
    return 0 if end.is_log_whole else EXIT_FAILED


def _flight_config(arguments: argparse.Namespace) -> CompanionConfig:
    """Return the file's configuration, with the command line's changes."""
    config = load_config(arguments.fly_config)
    if arguments.fence is not None:
        config = with_fence(config, arguments.fence)
    if arguments.signing_key is not None:
        config = with_signing_key(config, arguments.signing_key)
    return with_kept_offsets(with_radios(config, arguments.radio, arguments.fly_config))


def fly_demo(arguments: argparse.Namespace) -> int:
    """Search for a simulated emitter, and return the exit code."""
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
    settings = requested_settings(arguments)
    pages: list[WebView] = []

    def make_views(config: CompanionConfig, truth_enu_m: tuple[float, float]) -> list[FlightView]:
        if settings is not None:
            pages.append(_open_map(settings, config, truth_enu_m, outlives=True))
            if not arguments.no_browser:
                open_page(pages[0].url)
        return [*pages, _console_view()]

    def report(directory: Path) -> None:
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


def _report_flight(tiles: Path | None, directory: Path) -> None:
    """Write the report of a flight; a long one's only on request, to keep the exit quick."""
    from companion.report.page import is_quick

    if is_quick(directory):
        _write_report(directory, tiles)
    else:
        command = f"companion report {shlex.quote(str(directory))}"
        print(f"companion: make the report with: {command}", file=sys.stderr)


def _write_report(directory: Path, tiles: Path | None) -> Path | None:
    from companion.report.page import write_report  # load jinja2 only for a report

    try:
        path = write_report(directory, tiles=tiles)
    except CompanionError as error:
        print(f"companion: no report: {error}", file=sys.stderr)
        return None
    logging.getLogger("companion").info("report: %s", path)
    return path


def _open_map(
    settings: WebSettings,
    config: CompanionConfig,
    truth_enu_m: tuple[float, float] | None = None,
    *,
    outlives: bool = False,
) -> WebView:
    """Start the map, and print its address."""
    page = WebView(settings, config, truth_enu_m, outlives=outlives)
    print(f"live map: {page.url}", file=sys.stderr)
    return page


def _console_view() -> FlightView:
    """Return the live screen on a terminal, else lines of the log."""
    if not sys.stderr.isatty() or os.environ.get("TERM", "dumb") == "dumb":
        return PlainView()
    try:
        from companion.view.terminal import TerminalView
    except ImportError:
        print(f"for the live screen: {how_to_install('rich')}", file=sys.stderr)
        return PlainView()
    view = TerminalView()
    set_up_logging(quiet=False, stream=view.stream)
    return view


def warm_up(arguments: argparse.Namespace) -> int:
    """Compile the kernels, and return the exit code."""
    load_config(arguments.config)
    try:
        print(compile_kernels())
    except CompanionError as error:
        print(f"companion: {error}", file=sys.stderr)
        print("companion: kernels run as plain Python, which suffices in flight", file=sys.stderr)
        return EXIT_FAILED
    return 0
