"""A replay on the live map: what the operator saw, or another configuration would have shown."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from companion.config.schema import CompanionConfig
from companion.link.endpoint import CompanionEndpoint
from companion.replay.command import FlightReplay, Pace, Say, replay_flight
from companion.replay.recorded import open_recording
from companion.web.settings import WebSettings
from companion.web.view import WebView

REFRESH_S = 0.25


class MapOfReplay:
    """Feeds the page from a replay, and goes on showing its last moment.

    Args:
        view: The page.
        speed: Times real time.
    """

    def __init__(self, view: WebView, speed: float) -> None:
        self._view = view
        self._pace = Pace(speed)
        self._last: tuple[CompanionEndpoint, float] | None = None

    def __call__(self, endpoint: CompanionEndpoint, now_s: float) -> None:
        """Wait until it is time for this input, and show what came of it."""
        self._pace(endpoint, now_s)
        self._last = (endpoint, now_s)
        self._view.update(endpoint, now_s)

    def linger(self, is_over: Callable[[], bool] = lambda: False) -> None:
        """Show the last moment until Ctrl-C, so that the page does not call it old.

        Args:
            is_over: Ends it, too.
        """
        if self._last is None:
            return
        endpoint, ended_s = self._last
        began_s = time.monotonic()
        try:
            while not is_over():
                # The page gets its pictures by the flight's clock, which therefore goes on.
                self._view.show(endpoint, ended_s, ended_s + time.monotonic() - began_s)
                time.sleep(REFRESH_S)
        except KeyboardInterrupt:
            return


def replay_on_map(
    path: Path,
    config: CompanionConfig | None,
    say: Say,
    settings: WebSettings,
    speed: float,
    done: Callable[[FlightReplay], None],
) -> FlightReplay:
    """Run a recorded flight again on the live map, and stay there until Ctrl-C.

    Args:
        path: Its folder, a file in it, or an MCAP file.
        config: Another configuration; None: the flight's own.
        say: Takes remarks for people.
        settings: Of the page; there are no buttons, whatever they say.
        speed: Times real time.
        done: Gets the result as soon as it is there.

    Raises:
        ConfigError: The flight cannot be read.
        CompanionError: The page cannot be served.
    """
    used = open_recording(path).facts.config if config is None else config
    view = WebView(settings, used)
    try:
        say(f"live map: {view.url}; Ctrl-C ends it")
        page = MapOfReplay(view, speed)
        replay = replay_flight(path, config, say, page, view.listen)
        done(replay)
        page.linger()
    finally:
        view.close()
    return replay
