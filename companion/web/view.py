"""Joins a flight and its page: pictures to the child process, buttons to the session."""

from __future__ import annotations

from functools import partial

from companion.config.schema import CompanionConfig
from companion.guidance.events import Wish
from companion.link.endpoint import CompanionEndpoint
from companion.link.journal import Journal
from companion.view.collector import Collector
from companion.view.picture import Json, picture_of, scene_of
from companion.view.tee import TeeJournal
from companion.view.time_to_go import TimeToGo
from companion.web.process import WebProcess, url_to_tell
from companion.web.settings import WebSettings

ROOM_S = 0.012
"""Before the next control tick; nearer to it a picture, some milliseconds, could delay it."""


class WebView:
    """The live map of one flight.

    Args:
        settings: Where, and for whom.
        config: Of the flight.
        truth_enu_m: Where the emitter is, if somebody knows it (the simulator does).

    Raises:
        CompanionError: The port is taken, or the extra `web` is not installed.
    """

    def __init__(
        self,
        settings: WebSettings,
        config: CompanionConfig,
        truth_enu_m: tuple[float, float] | None = None,
    ) -> None:
        self._settings = settings
        self._collector = Collector()
        mission = config.mission
        self._time_to_go = TimeToGo(mission.stop_radius_m, mission.stop_confirm_s)
        self._process = WebProcess(settings, {**scene_of(config), "truth": truth_enu_m})

    @property
    def url(self) -> str:
        """Where the page is, for people."""
        return url_to_tell(self._settings)

    @property
    def process_id(self) -> int:
        """Of the process that serves the page."""
        return self._process.process_id

    def listen(self, journal: Journal) -> Journal:
        """A journal that tells the page what it tells the flight log."""
        return TeeJournal(journal, self._collector)

    def update(self, endpoint: CompanionEndpoint, now_s: float) -> None:
        """Called at every wake-up of the flight; costs nothing unless a picture is due.

        Args:
            endpoint: The companion; buttons go to it.
            now_s: The present.
        """
        has_room = endpoint.next_timer_s() - now_s >= ROOM_S
        make = partial(self._picture, endpoint, now_s)
        for name in self._process.update(now_s, make, may_send=has_room):
            endpoint.ask(Wish(name), now_s)

    def show(self, endpoint: CompanionEndpoint, now_s: float, clock_s: float) -> None:
        """Show a moment that is over, whatever buttons are pressed.

        Args:
            endpoint: The companion.
            now_s: The moment.
            clock_s: Goes on.
        """
        self._process.update(clock_s, lambda: self._picture(endpoint, now_s))

    def close(self) -> None:
        """End the page."""
        self._process.close()

    def _picture(self, endpoint: CompanionEndpoint, now_s: float) -> Json:
        params, estimate = endpoint.session.params, endpoint.session.estimate
        self._time_to_go.aim(params.stop_radius_m, params.stop_confirm_s)
        r95_m = None if estimate is None else estimate.r95_m
        return {
            **picture_of(endpoint, now_s),
            "time_to_go_s": self._time_to_go.observe(now_s, r95_m),
            "texts": list(self._collector.texts),
            "marks": list(self._collector.marks),
            "curve": self._collector.take_curve(),
        }
