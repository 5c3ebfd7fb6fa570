from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.mav.dialect import mavlink
from sim_link.autopilot.protocols.addressing import StatusTexts
from tests.unit.sim_link.autopilot.protocols.wire import said


def read(texts: StatusTexts, text: str) -> list[mavlink.MAVLink_statustext_message]:
    chunks = [said(message) for message in texts.messages(4, text)]
    return [c for c in chunks if isinstance(c, mavlink.MAVLink_statustext_message)]


@pytest.mark.parametrize("text", ["", "Arming denied", "x" * 50])
def test_a_text_of_up_to_fifty_characters_is_one_message_with_id_zero(text: str) -> None:
    (only,) = read(StatusTexts(), text)
    assert (only.text, only.id, only.severity) == (text, 0, 4)


@pytest.mark.parametrize(("length", "chunks"), [(51, 2), (99, 2), (100, 3), (101, 3), (150, 4)])
def test_the_last_chunk_has_room_for_the_nul_that_ends_it(length: int, chunks: int) -> None:
    parts = read(StatusTexts(), "y" * length)
    assert [part.chunk_seq for part in parts] == list(range(chunks))
    assert [len(part.text) for part in parts[:-1]] == [50] * (chunks - 1)
    assert len(parts[-1].text) < 50


@given(text=st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=400))
def test_the_chunks_joined_are_the_text(text: str) -> None:
    assert "".join(part.text for part in read(StatusTexts(), text)) == text


def test_each_long_text_has_its_own_id_and_never_zero() -> None:
    texts = StatusTexts()
    ids = [read(texts, "z" * 60)[0].id for _ in range(3)]
    assert ids == [1, 2, 3]
    texts._last_id = 0xFFFF
    assert {part.id for part in read(texts, "z" * 60)} == {1}


def test_what_is_not_ascii_is_shown_as_a_question_mark() -> None:
    assert [part.text for part in read(StatusTexts(), "5 \N{DEGREE SIGN}")] == ["5 ?"]
