"""Messages that the page's process makes of the pictures."""

import asyncio
import json
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from fastapi import FastAPI

from companion.io.files import plain
from companion.search.search_grid import WeightedArea, grid_over
from companion.search.searched_area import SearchState
from companion.view.history import PackedState, drawn
from companion.web import server
from companion.web.server import PictureFeed
from companion.web.settings import Access

FIRST = {"t_s": 1.0, "track": [[[0.0, 0.0], [5.0, 0.0]], True], "curve": [[{"t_s": 1.0}], True]}


def test_a_picture_brings_what_the_page_lacks() -> None:
    hub = PictureFeed({})
    hub.take(dict(FIRST))
    hub.take({"t_s": 2.0, "track": [[[9.0, 9.0]], False], "curve": [[], False]})
    assert hub.track.items == [[0.0, 0.0], [5.0, 0.0], [9.0, 9.0]]
    assert [point["t_s"] for point in hub.curve.items] == [1.0]
    assert hub.picture == {"t_s": 2.0, "searched_version": 0}
    assert hub.version == 2


def test_a_whole_track_replaces_what_was_there() -> None:
    hub = PictureFeed({})
    hub.take(dict(FIRST))
    version = hub.track.version
    hub.take({"t_s": 0.1, "track": [[[1.0, 1.0]], True]})
    assert hub.track.items == [[1.0, 1.0]]
    assert hub.track.version != version


def test_the_searched_area_is_drawn_once_for_each_change(monkeypatch: pytest.MonkeyPatch) -> None:
    draw = Mock(side_effect=drawn)
    monkeypatch.setattr("companion.web.server.drawn", draw)
    hub = PictureFeed({})
    grid = grid_over([WeightedArea(((0.0, 0.0), (100.0, 0.0), (100.0, 80.0), (0.0, 80.0)))], 20.0)
    versions = []
    for pod in (0.2, None, 0.9):
        if pod is None:
            part: Any = [[], False]
        else:
            packed = PackedState.of(SearchState(grid, np.full(len(grid.poa), pod)))
            part = [[plain(packed)], True]
        hub.take({"searched_area": part})
        answers = [json.loads(hub.searched_json()) for _page in range(3)]
        assert answers[0] == answers[1] == answers[2]
        assert answers[0]["version"] == hub.picture["searched_version"]
        versions.append(answers[0]["version"])
        assert "searched_area" not in hub.picture
    assert versions[0] == versions[1] != versions[2]
    assert draw.call_count == 2
    assert answers[0]["area"]["gaps"] == []


def test_without_a_search_the_area_is_empty() -> None:
    hub = PictureFeed({})
    hub.take({"t_s": 1.0})
    assert json.loads(hub.searched_json()) == {"version": 0, "area": None}


@pytest.mark.parametrize(("query", "status"), [("", 403), ("token=correct-horse", 200)])
def test_only_who_may_look_gets_the_searched_area(query: str, status: int) -> None:
    app = FastAPI()
    server._add_searched(app, Access("0.0.0.0", "correct-horse"), PictureFeed({}))
    scope = {
        "type": "http",
        "method": "GET",
        "path": "/searched.json",
        "query_string": query.encode(),
        "headers": [],
        "client": ("192.0.2.7", 9),
    }
    sent: list[Any] = []

    async def receive() -> Any:
        return {"type": "http.request", "body": b""}

    async def send(message: Any) -> None:
        sent.append(message)

    asyncio.run(app(scope, receive, send))
    assert sent[0]["status"] == status
