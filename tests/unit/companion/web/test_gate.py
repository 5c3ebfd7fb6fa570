"""Requests refused before a page is made, and headers of every answer."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from fastapi.responses import PlainTextResponse

from companion.web import server
from companion.web.server import AccessGate
from companion.web.settings import Access

OPEN, CLOSED = Access("127.0.0.1", None), Access("0.0.0.0", "correct-horse")


def answer(access: Access, path: str = "/", query: str = "", host: str = "localhost") -> Any:
    """Status and headers of an answer; a page that is made has the status 200."""
    sent: list[Any] = []
    scope = {
        "type": "http",
        "path": path,
        "query_string": query.encode(),
        "headers": [(b"host", host.encode())],
        "client": ("127.0.0.1", 9),
    }

    async def receive() -> Any:
        return {"type": "http.request", "body": b""}

    async def send(message: Any) -> None:
        sent.append(message)

    asyncio.run(AccessGate(PlainTextResponse("a page"), access)(scope, receive, send))
    return sent[0]["status"], dict(sent[0]["headers"])


@pytest.mark.parametrize(
    ("access", "query", "host", "status"),
    [
        (OPEN, "", "localhost", 200),
        (OPEN, "", "evil.example", 421),
        (OPEN, "", "[::1", 421),
        (CLOSED, "", "localhost", 403),
        (CLOSED, "token=wrong-horse", "localhost", 403),
        (CLOSED, "token=correct-horse", "localhost", 200),
    ],
)
def test_who_may_not_look_gets_no_page(access: Access, query: str, host: str, status: int) -> None:
    found, headers = answer(access, query=query, host=host)
    assert found == status
    assert headers[b"x-frame-options"] == b"DENY"
    assert b"frame-ancestors 'none'" in headers[b"content-security-policy"]
    assert headers[b"referrer-policy"] == b"no-referrer"


def test_too_many_browsers_are_refused_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "MAX_PAGES", 0)
    assert answer(OPEN)[0] == 503
    assert answer(OPEN, path="/tiles/1/2/3.png")[0] == 200
