"""The child process that serves the page: pictures from standard input, buttons to output.

The page has the map, phase, numbers, ages, emitters, texts, curves and buttons; `search_map.js`
draws the map. The page's data (`PictureFeed`) are as much as the flight sends, which is bounded.

All contents come from outside sooner or later (an autopilot's text, an emitter's name), so texts go
into labels, which escape, and never into HTML.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import resource
import signal
import socket
import sys
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import nicegui
import uvicorn
from fastapi import FastAPI, Request
from fastapi.datastructures import QueryParams
from fastapi.responses import PlainTextResponse, Response
from nicegui import Client, ui
from nicegui.element import Element

from companion.io.files import json_line
from companion.view.history import History, HistoryPart, HistoryReader, PackedState, drawn
from companion.web.command_buttons import CommandButtons, HandoffButton, Press
from companion.web.panels import (
    AgeBars,
    Charts,
    EmitterList,
    Numbers,
    PhaseBar,
    RadioList,
    TextList,
)
from companion.web.settings import LEFT, VIEWED, Access, WebSettings, tile, zooms_of


class PictureFeed:
    """Latest picture, history and searched area, read by the pages."""

    def __init__(self, scene: Mapping[str, Any]) -> None:
        self.scene = scene
        self.picture: dict[str, Any] = {}
        self.version = 0
        self.track: History[list[float]] = History()
        self.curve: History[dict[str, Any]] = History()
        self.searched: History[dict[str, Any]] = History()
        self._drawn = (-1, b"")

    def take(self, picture: dict[str, Any]) -> None:
        """Set the picture, and append its parts of track and curves."""
        self.track.take(HistoryPart(*picture.pop("track", ((), False))))
        self.curve.take(HistoryPart(*picture.pop("curve", ((), False))))
        self.searched.take(HistoryPart(*picture.pop("searched_area", ((), False))))
        self.picture = {**picture, "searched_version": self.searched.version}
        self.version += 1

    def searched_json(self) -> bytes:
        """Return the map of the searched area, drawn once for all pages that ask for it."""
        version, items = self.searched.version, self.searched.items
        if self._drawn[0] != version:
            area = drawn(PackedState(**items[0])) if items else None
            self._drawn = (version, json_line({"version": version, "area": area}))
        return self._drawn[1]


LEAFLET = Path(nicegui.__file__).parent / "elements" / "leaflet" / "dist"
WHOLE_EVERY = 40
"""Pictures after which the whole track is sent again, should a part have been lost."""


class SearchMap(Element, component="search_map.js", esm={"nicegui-leaflet": str(LEAFLET)}):
    """Leaflet on a grid in metres, or on tiles from a folder, of the zooms found in it."""

    def __init__(self, scene: Mapping[str, Any], tile_zooms: tuple[int, int] | None) -> None:
        super().__init__()
        self.add_resource(LEAFLET)
        self._props["scene"] = dict(scene)
        self._props["zooms"] = tile_zooms
        self._reader = HistoryReader(WHOLE_EVERY)

    def show(self, hub: PictureFeed) -> None:
        """Draw the latest moment and the track."""
        points, is_whole = self._reader.next_part(hub.track)
        self.run_method("show", hub.picture, points, is_whole)


REFRESH_S = 0.3
STYLE = Path(__file__).with_name("style.css")
LIVE_WATCH = Path(__file__).with_name("live_watch.js")


class Page:
    """One browser's page; without `press`, which sends a button's name, it has no buttons."""

    def __init__(
        self, hub: PictureFeed, *, tile_zooms: tuple[int, int] | None, press: Press | None
    ) -> None:
        self._hub = hub
        self._shown = 0
        """Version shown; none yet: a replay begins when a browser has opened the page."""
        ui.dark_mode(None)
        ui.add_css(STYLE)
        ui.add_head_html('<script>document.documentElement.lang = "en"</script>')
        ui.add_head_html(f"<script>{LIVE_WATCH.read_text(encoding='utf-8')}</script>")
        phase = PhaseBar(hub.scene.get("replay"))
        with ui.row().classes("w-full gap-2 halves"):
            with ui.column().classes("gap-1 map-half"):
                self._map = SearchMap(hub.scene, tile_zooms)
                with ui.row().classes("w-full items-start justify-end gap-2 buttons"):
                    handoff = HandoffButton()
                    self._commands = None if press is None else CommandButtons(press)
            with ui.column().classes("gap-2 side"):
                panels = (Numbers(hub.scene), AgeBars(hub.scene), EmitterList(), RadioList())
                texts = TextList()
        self._parts = (phase, *panels, handoff, texts)
        self._charts = Charts(hub.scene)
        ui.timer(REFRESH_S, self._refresh)

    def _refresh(self) -> None:
        hub = self._hub
        if self._commands is not None:
            self._commands.check_answers()
        if hub.version == self._shown:
            return
        self._shown = hub.version
        picture: dict[str, Any] = hub.picture
        self._map.show(hub)
        for part in self._parts:
            part.show(picture)
        if self._commands is not None:
            self._commands.show(picture)
        ui.run_javascript(f"pictureHeard({json.dumps(picture.get('is_over', False))})")
        self._charts.show(hub.curve.items)


NICENESS = 19
"""Niceness of the pages: on a loaded computer the control tick comes first."""
MAX_DATA_BYTES = 512 * 2**20
"""Data that the page's process may allocate: half of the service's limit (MemoryMax)."""
OOM_SCORE = b"500"
"""If memory runs out, the kernel ends the page before the flight, which restarts it."""
MAX_LINE = 4_000_000
"""Longest line; a picture has about 20 kB."""
REFUSED = "This page needs its token: open the address that the companion printed."
Scope = dict[str, Any]
Receive = Callable[[], Awaitable[Any]]
Send = Callable[[Any], Awaitable[None]]


PAGE = "/"
MAX_PAGES = 24
"""Open browsers; each costs the page's process about 0.6 MB."""
MAX_LOADING = 8
"""Pages without a connected browser yet: the oldest is dropped."""
FULL = "Too many browsers have this page open: close one of them."
HEADERS = {
    b"x-frame-options": b"DENY",
    b"content-security-policy": b"default-src 'self'; img-src 'self' data: blob:; "
    b"font-src 'self' data:; style-src 'self' 'unsafe-inline'; "
    b"script-src 'self' 'unsafe-inline' 'unsafe-eval'; object-src 'none'; base-uri 'self'; "
    b"form-action 'none'; frame-ancestors 'none'",
    b"referrer-policy": b"no-referrer",
    b"x-content-type-options": b"nosniff",
}
"""Headers of every answer: no other site frames it, and none learns the token from a link. NiceGUI
has its scripts in the page, and Vue compiles templates in the browser."""


class AccessGate:
    """Refuses foreign pages and clients without access (`web.settings`) before a page is made."""

    def __init__(self, app: Any, access: Access) -> None:
        self._app = app
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on with the security headers, or refuse it."""
        if scope["type"] == "http":
            refusal = self._refusal(scope)

            async def sent(message: Any) -> None:
                if message["type"] == "http.response.start":
                    message["headers"] = [*message.get("headers", ()), *HEADERS.items()]
                await send(message)

            await (self._app if refusal is None else refusal)(scope, receive, sent)
        elif scope["type"] == "websocket" and not self._is_ours(scope):
            await send({"type": "websocket.close", "code": 1008})
        else:
            await self._app(scope, receive, send)

    def _refusal(self, scope: Scope) -> Response | None:
        if not self._is_ours(scope):
            return PlainTextResponse("wrong host", 421)
        if scope["path"] != PAGE:
            return None
        client = scope.get("client")
        token = QueryParams(scope["query_string"]).get("token")
        if not self._access.may_view("" if client is None else client[0], token):
            return PlainTextResponse(REFUSED, 403)
        return PlainTextResponse(FULL, 503) if len(Client.instances) >= MAX_PAGES else None

    def _is_ours(self, scope: Scope) -> bool:
        headers = {name: value.decode("latin-1") for name, value in scope["headers"]}
        host = headers.get(b"host", "")
        if not self._access.is_host_ours(host):
            return False
        return self._access.is_origin_ours(headers.get(b"origin"), host)


class LoadingPages:
    """Pages and their browsers; of those without a connected browser the oldest is dropped."""

    def __init__(self) -> None:
        self._clients: dict[str, Client] = {}
        self._viewing: set[str] = set()

    def add(self, client: Client) -> None:
        """Add a page, and drop the oldest one if there are too many."""
        self._clients[client.id] = client
        client.on_connect(lambda: self._connected(client.id))
        client.on_delete(lambda: self._deleted(client.id))
        if len(self._clients) > MAX_LOADING:
            next(iter(self._clients.values())).delete()

    def _connected(self, client_id: str) -> None:
        """Report a browser once, however often its connection comes back."""
        self._clients.pop(client_id, None)
        if client_id not in self._viewing:
            self._viewing.add(client_id)
            _send_line(VIEWED)

    def _deleted(self, client_id: str) -> None:
        self._clients.pop(client_id, None)
        if client_id in self._viewing:
            self._viewing.remove(client_id)
            _send_line(LEFT)


def build_app(
    hub: PictureFeed, access: Access, tiles: Path | None, press: Callable[[str], None]
) -> FastAPI:
    """Return the web application."""
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    app.add_middleware(AccessGate, access=access)
    zooms = None if tiles is None else zooms_of(tiles)
    loading = LoadingPages()

    @ui.page(PAGE, title="Companion" if hub.scene.get("replay") is None else "Companion: replay")
    def page(request: Request, token: str | None = None) -> None:
        client = "" if request.client is None else request.client.host
        may_press = access.may_control(client, token)
        Page(hub, tile_zooms=zooms, press=press if may_press else None)
        loading.add(ui.context.client)

    @nicegui.app.exception_handler(404)
    def nothing(_request: Request, _error: Exception) -> PlainTextResponse:
        return PlainTextResponse("not found", 404)  # NiceGUI would make a page for each

    _add_searched(app, access, hub)
    if tiles is not None:
        _add_tiles(app, access, tiles)
    # Quasar shows a bar without a name while a request is under way: the page has its own ages.
    nicegui.app.config.quasar_config["loadingBar"]["skipHijack"] = True
    ui.run_with(app, title="Companion", show_welcome_message=False, reconnect_timeout=10.0)
    return app


def _may_view(access: Access, request: Request, token: str | None) -> bool:
    return access.may_view("" if request.client is None else request.client.host, token)


def _add_searched(app: FastAPI, access: Access, hub: PictureFeed) -> None:
    """Serve the map of the searched area, which a page asks for when its version changes."""

    @app.get("/searched.json")
    def searched(request: Request, token: str | None = None) -> Response:
        if not _may_view(access, request, token):
            return PlainTextResponse(REFUSED, 403)
        headers = {"cache-control": "no-store"}
        return Response(hub.searched_json(), media_type="application/json", headers=headers)


def _add_tiles(app: FastAPI, access: Access, folder: Path) -> None:
    """Serve map tiles to clients with access: they show the site of the search."""

    @app.get("/tiles/{zoom}/{x}/{y}.png")
    def one(request: Request, zoom: int, x: int, y: int, token: str | None = None) -> Response:
        if not _may_view(access, request, token):
            return PlainTextResponse(REFUSED, 403)
        return Response(tile(folder, zoom, x, y), media_type="image/png")


async def serve() -> None:
    """Serve until standard input ends."""
    reader = asyncio.StreamReader(limit=MAX_LINE)
    loop = asyncio.get_running_loop()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    line = await reader.readline()
    if not line.endswith(b"\n"):
        return
    first: Mapping[str, Any] = json.loads(line)
    hub = PictureFeed(first["scene"])
    settings = WebSettings(**first["settings"])
    tiles = None if settings.tiles is None else Path(settings.tiles)
    app = build_app(hub, settings, tiles, _send_line)
    listener = socket.socket(fileno=first["fd"])
    server = uvicorn.Server(
        uvicorn.Config(
            app, log_level="warning", access_log=False, lifespan="on", ws_ping_timeout=10
        )
    )
    serving = asyncio.create_task(server.serve(sockets=[listener]))
    while (line := await reader.readline()).endswith(b"\n"):  # the last one may be cut off
        hub.take(json.loads(line))
    server.should_exit = True
    await serving


def _send_line(name: str) -> None:
    """Write a line to the companion, such as the name of a button, which it may refuse."""
    os.write(sys.stdout.fileno(), f"{name}\n".encode())


def main() -> None:
    """Run the child process; the terminal's Ctrl-C is for the companion."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
    with suppress(OSError, ValueError):  # a lower limit of the system stays
        resource.setrlimit(resource.RLIMIT_DATA, (MAX_DATA_BYTES, MAX_DATA_BYTES))
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_bytes(OOM_SCORE)
    logging.getLogger("nicegui").setLevel(logging.WARNING)
    asyncio.run(serve())


if __name__ == "__main__":
    main()
