"""The child process: pictures from standard input, buttons to standard output, pages between."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
import socket
import sys
import time
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any

import uvicorn
from fastapi import FastAPI, Request
from fastapi.responses import PlainTextResponse, Response
from nicegui import ui

from companion.web.access import Access
from companion.web.hub import Hub
from companion.web.page import Page
from companion.web.tiles import tile, zooms_of

NICENESS = 19
"""On a computer with too much to do the control tick comes first, and pages wait."""
MAX_LINE = 4_000_000
"""A picture has some 20 kB."""
REFUSED = "This page needs its token: open the address that the companion printed."
Scope = dict[str, Any]
Receive = Callable[[], Awaitable[Any]]
Send = Callable[[Any], Awaitable[None]]


class HostCheck:
    """Refuses requests that foreign pages may have caused; see `companion.web.access`.

    Args:
        app: What is behind it.
        access: The rules.
    """

    def __init__(self, app: Any, access: Access) -> None:
        self._app = app
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on, or refuse."""
        if scope["type"] in ("http", "websocket") and not self._is_ours(scope):
            if scope["type"] == "http":
                await PlainTextResponse("wrong host", 421)(scope, receive, send)
            else:
                await send({"type": "websocket.close", "code": 1008})
            return
        await self._app(scope, receive, send)

    def _is_ours(self, scope: Scope) -> bool:
        headers = {name: value.decode("latin-1") for name, value in scope["headers"]}
        host = headers.get(b"host", "")
        if not self._access.is_host_ours(host):
            return False
        return self._access.is_origin_ours(headers.get(b"origin"), host)


def build_app(
    hub: Hub, access: Access, tiles: Path | None, press: Callable[[str], None]
) -> FastAPI:
    """The web application.

    Args:
        hub: What is known.
        access: Who may do what.
        tiles: Folder of map tiles.
        press: Passes a button on.
    """
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    app.add_middleware(HostCheck, access=access)
    zooms = None if tiles is None else zooms_of(tiles)

    @ui.page("/", title="Companion")
    def page(request: Request, token: str | None = None) -> PlainTextResponse | None:
        """The live map, for those who may look."""
        client = "" if request.client is None else request.client.host
        if not access.may_view(client, token):
            return PlainTextResponse(REFUSED, 403)
        may_press = access.may_control(client, token)
        Page(
            hub,
            tile_zooms=zooms,
            press=press if may_press else None,
            wall_s=time.monotonic,
        )
        return None

    if tiles is not None:
        _add_tiles(app, access, tiles)
    ui.run_with(app, title="Companion", show_welcome_message=False, reconnect_timeout=10.0)
    return app


def _add_tiles(app: FastAPI, access: Access, folder: Path) -> None:
    """Serve map tiles, to those who may look: where a search is, is a part of it."""

    @app.get("/tiles/{zoom}/{x}/{y}.png")
    def one(request: Request, zoom: int, x: int, y: int, token: str | None = None) -> Response:
        """A map tile, for those who may look."""
        client = "" if request.client is None else request.client.host
        if not access.may_view(client, token):
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
    hub = Hub(first["scene"])
    access = Access(first["host"], first["token"], first["is_control_on"], first["is_view_open"])
    tiles = None if first["tiles"] is None else Path(first["tiles"])
    app = build_app(hub, access, tiles, _press)
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


def _press(name: str) -> None:
    """Tell the companion; it decides whether that is possible now."""
    os.write(sys.stdout.fileno(), f"{name}\n".encode())


def main() -> None:
    """Run the child process; the terminal's Ctrl-C is for the companion."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(NICENESS)
    logging.getLogger("nicegui").setLevel(logging.WARNING)
    asyncio.run(serve())
