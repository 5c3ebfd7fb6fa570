from __future__ import annotations

import io

import pytest

from tools.console import LINE_EVERY_S, progress_lines, shown, span_text


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_line_now_and_then_says_how_much_is_left() -> None:
    stream, now_s = io.StringIO(), [100.0]
    add = progress_lines(200.0, stream, lambda: now_s[0])
    add(10.0)
    assert stream.getvalue() == ""
    now_s[0] += LINE_EVERY_S
    add(40.0)
    add(40.0)
    assert stream.getvalue() == " 25% done, about 45 s left\n"


def test_no_bar_where_there_is_no_terminal() -> None:
    stream = io.StringIO()
    with shown(2.0, stream) as on_done:
        on_done(2.0)
    assert stream.getvalue() == ""


def test_a_bar_on_a_terminal() -> None:
    stream = _Terminal()
    with shown(2.0, stream) as on_done:
        on_done(1.0)
        on_done(1.0)
    assert "100%" in stream.getvalue()


@pytest.mark.parametrize(("seconds", "text"), [(3.4, "3 s"), (99.0, "99 s"), (245.0, "4 min 05 s")])
def test_spans_of_time(seconds: float, text: str) -> None:
    assert span_text(seconds) == text
