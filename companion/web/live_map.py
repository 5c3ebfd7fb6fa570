"""Live map of a flight: snapshots to a child process, button presses to the session.

Theory of operation. Browsers, however many or slow, must not delay the control tick. So the page
lives in another process: pictures go down a pipe as JSON lines, a few times a second, and only when
the pipe has room; a picture that does not fit is dropped, because a newer one replaces it anyway.
Buttons come back up another pipe. If the child dies, it is restarted, at ever longer intervals;
meanwhile the browser itself shows that its page is not live. The listening socket is opened here,
before the flight, so that a taken port is an error at once, and kept, so that browsers find the
next child.

The collector receives the events of the flight log, so no value is measured twice; its lists are
bounded. Track, curves and searched area are not in every picture, and any picture may be lost: the
collector has them all, and a picture carries the part that the page lacks.
"""

from __future__ import annotations

import errno
import ipaddress
import logging
import os
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from typing import Any

from companion.config.schema import CompanionConfig
from companion.domain import EstimateState
from companion.errors import CompanionError, how_to_install
from companion.guidance.commands import Severity
from companion.guidance.events import OperatorCommand, OperatorCommandReceived
from companion.io.files import json_line
from companion.link.endpoint import CompanionEndpoint
from companion.run import FlightView
from companion.view.history import (
    CurveHistory,
    FlightTrack,
    History,
    HistoryPart,
    HistoryReader,
    SearchedHistory,
)
from companion.view.snapshot import Json, TimeToGo, picture_of, scene_of
from companion.web.settings import LEFT, VIEWED, WebSettings

TEXTS = 50
MARKS = 12
"""Rings and bearings that a map shows at once; more of them hide the estimate."""
MARK_FIELDS = ("sensor_enu_m", "range_m", "bearing_enu_rad", "range_weight", "emitter_id")
CURVE_FIELDS = ("range_innovation", "range_offset_m", "r95_m", "nis")

Sample = dict[str, object]


class Collector(FlightView):
    """Collects texts, marks, the track and the curves."""

    def __init__(self) -> None:
        self.texts: deque[tuple[float, str, str]] = deque(maxlen=TEXTS)
        """Texts with their time_s and severity."""
        self.marks: deque[Sample] = deque(maxlen=MARKS)
        self._track, self._curve = FlightTrack(), CurveHistory()
        self._searched = SearchedHistory()
        self._origin_deg: tuple[object, object] | None = None
        self._starts = 0
        self._readers: dict[str, HistoryReader] = {}

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Add an event of the flight log."""
        if kind == "origin":
            origin_deg = (fields.get("latitude_deg"), fields.get("longitude_deg"))
            if origin_deg != self._origin_deg:
                self._track.clear()  # earlier positions are in another frame
            self._origin_deg = origin_deg
        elif kind == "position":
            self._track.add(tuple(fields["position_enu_m"])[:2])  # type: ignore[arg-type]
        elif kind == "estimate":
            self._take_estimate(fields, now_s)

    def _take_estimate(self, fields: Mapping[str, object], now_s: float) -> None:
        if fields.get("sensor_enu_m") is not None:
            self.marks.append({"t_s": now_s, **{name: fields.get(name) for name in MARK_FIELDS}})
        if self._curve.is_due(now_s):
            point = {"t_s": now_s, **{name: fields.get(name) for name in CURVE_FIELDS}}
            self._curve.add(point, now_s)

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        """Add a text for the operator."""
        self.texts.append((now_s, severity.name.lower(), text))

    def next_parts(self, starts: int) -> dict[str, HistoryPart[Any]]:
        """Return the parts of the histories that the page lacks: all after a restart."""
        histories: dict[str, History[Any]] = {
            "track": self._track,
            "curve": self._curve,
            "searched_area": self._searched,
        }
        if starts != self._starts:
            self._starts = starts
            self._readers = {name: HistoryReader() for name in histories}
        return {name: self._readers[name].next_part(each) for name, each in histories.items()}


log = logging.getLogger("companion.web")

PICTURE_PERIOD_S = 0.25
"""Period of pictures in flight time: faster than an eye needs, light on a Raspberry Pi."""
MAX_LINE = 1_000_000
"""Longest input without a line end; a longer one does not come from a button."""
END_S = 2.0
LAST_WAIT_S = 0.02
REAP_S = 0.01
"""Longest wait for a killed child to end: the control tick comes next."""
RESTART_S, LONGEST_RESTART_S = 1.0, 30.0
"""Time from the child's end to its restart, doubled each time up to the longest."""
LASTED_S = 60.0
"""Time that a child must have lasted for the next restart to be quick again."""
COMMANDS = {command.value: command for command in OperatorCommand}
FAR_AWAY = ("192.0.2.1", 9)
"""Unassigned address (RFC 5737): the route to it leaves by the network's own address."""
HINTS = {
    errno.EADDRINUSE: "is another program using the port?",
    errno.EACCES: "ports below 1024 need root",
}


class WebProcess:
    """Serves the page from a child process; the scene does not change during the flight."""

    def __init__(self, settings: WebSettings, scene: Mapping[str, object]) -> None:
        if find_spec("nicegui") is None:
            command = how_to_install("companion-guidance[web]")
            raise CompanionError(f"--web needs the extra web: {command}")
        self._listener = listening_socket(settings)
        fd = self._listener.fileno()
        self._first = _line({"fd": fd, "settings": settings, "scene": scene})
        self._next_s = 0.0
        self._is_over = False
        self._restart_s: float | None = None
        """Monotonic time at which the ended child is restarted; None while it runs."""
        self._restart_delay_s = RESTART_S
        self.starts = 0
        self.dropped = 0
        """Pictures that the child was too slow for."""
        self.is_viewed = False
        """True once a browser has opened the page."""
        self.viewers = 0
        """Browsers with the page open now; a closed one counts for a few seconds more."""
        self._start()

    def _start(self) -> None:
        self._child = subprocess.Popen(
            [sys.executable, "-m", "companion.web.server"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=(self._listener.fileno(),),
        )
        assert self._child.stdin is not None
        assert self._child.stdout is not None
        self.process_id = self._child.pid
        self._down, self._up = self._child.stdin.fileno(), self._child.stdout.fileno()
        os.set_blocking(self._down, False)
        os.set_blocking(self._up, False)
        self._unsent, self._received = self._first, b""
        self._started_s, self._restart_s = time.monotonic(), None
        self.starts += 1
        self.viewers = 0

    def update(
        self, now_s: float, picture: Callable[[], Mapping[str, object]], *, may_send: bool = True
    ) -> list[OperatorCommand]:
        """Send a picture if one is due and may be sent; return the buttons pressed since then."""
        if self._is_over:
            return []
        if self._restart_s is not None:
            if may_send and time.monotonic() >= self._restart_s:
                try:
                    self._start()
                except OSError as error:  # out of memory or file descriptors: try later
                    log.warning("the live map cannot be started again: %s", error.strerror)
                    self._restart_s = time.monotonic() + LONGEST_RESTART_S
            return []
        self._flush()
        if self._restart_s is not None:
            return []
        if may_send and now_s >= self._next_s:
            self._next_s = now_s + PICTURE_PERIOD_S
            if self._unsent:
                self.dropped += 1
            else:
                self._unsent = _line(picture())
                self._flush()
        return self._buttons()

    def close(self) -> None:
        """Stop the child, which ends by itself when its pipe does."""
        self._is_over = True
        self._listener.close()
        self._close_pipes()
        try:
            self._child.wait(END_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()

    def send_last(self, picture: Mapping[str, object]) -> None:
        """Send the final picture, and wait for a moment until it is on its way."""
        if self._is_over or self._restart_s is not None:
            return
        self._unsent += _line(picture)
        give_up_s = time.monotonic() + END_S
        while self._unsent and time.monotonic() < give_up_s:
            self._flush()
            time.sleep(LAST_WAIT_S)

    def _close_pipes(self) -> None:
        for pipe in (self._child.stdin, self._child.stdout):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()

    def _note_end(self) -> None:
        """Schedule a restart of the child that ended."""
        self._close_pipes()
        self._child.kill()  # it may have closed only its pipe
        with suppress(subprocess.TimeoutExpired):
            self._child.wait(REAP_S)
        self._unsent, self.viewers = b"", 0
        now_s = time.monotonic()
        if now_s - self._started_s >= LASTED_S:
            self._restart_delay_s = RESTART_S
        self._restart_s = now_s + self._restart_delay_s
        text = "the live map's process ended; it is started again in %g s, and the flight goes on"
        log.warning(text, self._restart_delay_s)
        self._restart_delay_s = min(2.0 * self._restart_delay_s, LONGEST_RESTART_S)

    def _flush(self) -> None:
        try:
            while self._unsent:
                sent = os.write(self._down, self._unsent)
                self._unsent = self._unsent[sent:]
        except BlockingIOError:
            pass
        except OSError:
            self._note_end()

    def _buttons(self) -> list[OperatorCommand]:
        if self._restart_s is not None:
            return []
        try:
            data = os.read(self._up, 65536)
        except (BlockingIOError, OSError):
            return []
        if not data:
            self._note_end()
            return []
        *lines, self._received = (self._received + data).split(b"\n")
        self._received = self._received[-MAX_LINE:]
        names = [line.decode("utf-8", errors="replace").strip() for line in lines]
        self.is_viewed = self.is_viewed or VIEWED in names
        self.viewers += names.count(VIEWED) - names.count(LEFT)
        return [COMMANDS[name] for name in names if name in COMMANDS]


def listening_socket(settings: WebSettings) -> socket.socket:
    """Return the socket of the page; raise `CompanionError` if it cannot be opened."""
    try:
        found = socket.getaddrinfo(settings.host, settings.port, type=socket.SOCK_STREAM)
        family, kind, protocol, _, address = found[0]
        listener = socket.socket(family, kind, protocol)
    except OSError as error:
        raise CompanionError(f"--web {settings.host}: no address of this computer") from error
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen()
    except OSError as error:
        listener.close()
        hint = HINTS.get(error.errno or 0, "is it an address of this computer?")
        raise CompanionError(
            f"--web {settings.host}:{settings.port}: cannot be opened ({error.strerror}); {hint}"
        ) from error
    return listener


def announced_url(settings: WebSettings) -> str:
    """Return the address for a browser, also on another device where the network is served."""
    try:
        if not ipaddress.ip_address(settings.host).is_unspecified:
            return settings.url
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect(FAR_AWAY)  # a datagram socket: finds the route, sends nothing
            return replace(settings, host=probe.getsockname()[0]).url
    except (OSError, ValueError):
        return settings.url


def _line(value: Mapping[str, object]) -> bytes:
    return json_line(value) + b"\n"


ROOM_S = 0.012
"""Spare time before the next control tick that a picture, some milliseconds, needs."""


@dataclass(frozen=True, slots=True)
class ReplayedFlight:
    """A past flight that is replayed."""

    began_unix_s: float
    banner: str
    """Banner of the page, so that a replay is not mistaken for a live flight."""


class WebView(Collector):
    """The live map of one flight, with the emitter's true position if it is known."""

    def __init__(
        self,
        settings: WebSettings,
        config: CompanionConfig,
        truth_enu_m: tuple[float, float] | None = None,
        replayed: ReplayedFlight | None = None,
        *,
        outlives: bool = False,
    ) -> None:
        """`replayed` is a past flight; None if it is live, and the page may outlive it."""
        super().__init__()
        self._outlives = outlives
        self._last: tuple[CompanionEndpoint, float] | None = None
        self._settings = settings
        self._time_to_go = TimeToGo()
        self._replayed = replayed
        banner = None if replayed is None else replayed.banner
        scene = {**scene_of(config), "truth": truth_enu_m, "replay": banner}
        self.process = WebProcess(settings, scene)

    @property
    def url(self) -> str:
        """Address of the page, for people."""
        return announced_url(self._settings)

    def update(self, endpoint: CompanionEndpoint, now_s: float) -> None:
        """Called at every wake-up of the flight; costs nothing unless a picture is due."""
        self._last = (endpoint, now_s)
        has_room = endpoint.next_tick_s - now_s >= ROOM_S
        make = partial(self._picture, endpoint, now_s)
        for command in self.process.update(now_s, make, may_send=has_room):
            endpoint.handle_event(OperatorCommandReceived(now_s, command))

    def show(self, endpoint: CompanionEndpoint, now_s: float, clock_s: float) -> None:
        """Show a past moment regardless of the buttons."""
        self.process.update(clock_s, lambda: self._picture(endpoint, now_s))

    def close(self) -> None:
        """Close the page, or leave it with the last moment if it outlives the flight."""
        if self._last is None or not self._outlives:
            self.process.close()
            return
        self.process.send_last({**self._picture(*self._last), "is_over": True})

    def await_left(self) -> None:
        """Close a page that outlived its flight once its last browser has left, or by Ctrl-C."""
        with suppress(KeyboardInterrupt):
            while self.process.viewers > 0:
                self.process.update(0.0, dict, may_send=False)
                time.sleep(PICTURE_PERIOD_S)
        self.process.close()

    def _picture(self, endpoint: CompanionEndpoint, now_s: float) -> Json:
        self._searched.look(endpoint.session)
        return {
            **picture_of(endpoint, now_s),
            "unix_s": self._unix_s(now_s),
            "frame": endpoint.session.vehicle.origin,
            "time_to_go_s": self._time_to_go.of_flight(endpoint, now_s),
            "texts": list(self.texts),
            "marks": list(self.marks),
            **self.next_parts(self.process.starts),
            "found": self._found(endpoint, now_s),
        }

    def _unix_s(self, now_s: float) -> float:
        return time.time() if self._replayed is None else self._replayed.began_unix_s + now_s

    def _found(self, endpoint: CompanionEndpoint, now_s: float) -> list[Sample]:
        """Return localised emitters and the origin; hand-offs are made on request (10 ms each)."""
        origin = endpoint.session.vehicle.origin
        if origin is None:
            return []
        unix_s = self._unix_s(now_s)
        return [
            {
                "emitter": str(emitter.emitter_id),
                "estimate": emitter.estimate,
                "origin": origin,
                "unix_s": unix_s,
            }
            for emitter in endpoint.session.emitters(now_s)
            if emitter.estimate is not None
            and (emitter.is_reported or emitter.estimate.state is EstimateState.LOCALISED)
        ]
