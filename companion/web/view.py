"""Joins a flight and its page: pictures to the child process, buttons to the session."""

from __future__ import annotations

from collections.abc import Callable

from companion.config.schema import CompanionConfig
from companion.link.endpoint import CompanionEndpoint
from companion.view.collector import Collector
from companion.view.picture import Json, picture_of, scene_of
from companion.view.time_to_go import TimeToGo
from companion.web.process import WebProcess
from companion.web.settings import WebSettings

Pressed = Callable[[str, float], None]
"""Takes a button's name and the time."""


class WebView:
    """The live map of one flight.

    Args:
        settings: Where, and for whom.
        config: Of the flight.
        collector: Listens to the flight log.
        truth_enu_m: Where the emitter is, if somebody knows it (the simulator does).

    Raises:
        CompanionError: The port is taken, or the extra `web` is not installed.
    """

    def __init__(
        self,
        settings: WebSettings,
        config: CompanionConfig,
        collector: Collector,
        truth_enu_m: tuple[float, float] | None = None,
    ) -> None:
        self._collector = collector
        mission = config.mission
        self._time_to_go = TimeToGo(mission.stop_radius_m, mission.stop_confirm_s)
        self._process = WebProcess(settings, {**scene_of(config), "truth": truth_enu_m})

    def update(self, endpoint: CompanionEndpoint, pressed: Pressed, now_s: float) -> None:
        """Called at every wake-up of the flight; costs nothing unless a picture is due.

        Args:
            endpoint: The companion.
            pressed: Takes the buttons.
            now_s: The present.
        """
        for name in self._process.update(now_s, lambda: self._picture(endpoint, now_s)):
            pressed(name, now_s)

    def close(self) -> None:
        """End the page."""
        self._process.close()

    def _picture(self, endpoint: CompanionEndpoint, now_s: float) -> Json:
        estimate = endpoint.session.estimate
        r95_m = None if estimate is None else estimate.r95_m
        return {
            **picture_of(endpoint, now_s),
            "time_to_go_s": self._time_to_go.observe(now_s, r95_m),
            "texts": list(self._collector.texts),
            "marks": list(self._collector.marks),
            "curve": self._collector.take_curve(),
        }
