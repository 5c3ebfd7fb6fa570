from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from companion.io.links.link import SPARE_SHARE, SendQueue

LIMIT = 400


def setpoint(number: int) -> bytes:
    return bytes((number,)) * 100


def text(number: int) -> bytes:
    return bytes((number,)) * 50


def drained(queue: SendQueue) -> bytes:
    data = queue.head()
    queue.consume(len(data))
    assert len(queue) == 0
    return data


def test_chunks_leave_in_their_order() -> None:
    queue = SendQueue(LIMIT)
    assert all(queue.add(setpoint(n)) for n in range(3))
    assert len(queue) == 300
    assert drained(queue) == setpoint(0) + setpoint(1) + setpoint(2)


def test_a_full_queue_gives_up_the_oldest() -> None:
    queue = SendQueue(LIMIT)
    assert all(queue.add(setpoint(n)) for n in range(10))
    assert queue.dropped == 6
    assert drained(queue) == b"".join(setpoint(n) for n in range(6, 10))


def test_what_is_droppable_goes_first() -> None:
    queue = SendQueue(LIMIT)
    queue.add(setpoint(1))
    queue.add(text(2), is_droppable=True)
    for number in (3, 4, 5):
        assert queue.add(setpoint(number))
    assert drained(queue) == setpoint(1) + setpoint(3) + setpoint(4) + setpoint(5)
    assert queue.dropped == 1


def test_what_is_droppable_is_not_let_in_where_much_waits() -> None:
    queue = SendQueue(LIMIT)
    queue.add(bytes(round(SPARE_SHARE * LIMIT)))
    assert queue.add(text(1), is_droppable=True)
    assert not queue.add(text(2), is_droppable=True)
    assert queue.add(setpoint(3))


def test_a_chunk_that_is_half_written_is_finished() -> None:
    queue = SendQueue(LIMIT)
    queue.add(setpoint(1))
    queue.consume(30)
    for number in range(2, 10):
        assert queue.add(setpoint(number))
    assert drained(queue).startswith(setpoint(1)[30:] + setpoint(7))


def test_a_half_written_chunk_leaves_no_room_for_one_of_the_whole_limit() -> None:
    queue = SendQueue(LIMIT)
    queue.add(setpoint(1))
    queue.consume(30)
    assert not queue.add(bytes(LIMIT))
    assert drained(queue) == setpoint(1)[30:]


def test_what_is_longer_than_the_limit_costs_nothing_that_waits() -> None:
    queue = SendQueue(LIMIT)
    queue.add(setpoint(1))
    assert not queue.add(bytes(LIMIT + 1))
    assert drained(queue) == setpoint(1)


_STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("add"), st.integers(1, 300), st.booleans()),
        st.tuples(st.just("write"), st.integers(0, 300), st.booleans()),
    ),
    max_size=80,
)


@given(_STEPS)
def test_whatever_happens_it_is_bounded_and_sends_whole_chunks_in_order(
    steps: list[tuple[str, int, bool]],
) -> None:
    queue, sent, added = SendQueue(LIMIT), b"", []
    for number, (kind, count, is_droppable) in enumerate(steps):
        if kind == "add":
            chunk = number.to_bytes(2, "big") + bytes(count)
            if queue.add(chunk, is_droppable=is_droppable):
                added.append(chunk)
        else:
            data = queue.head()[:count]
            queue.consume(len(data))
            sent += data
        assert len(queue) == len(queue.head()) <= LIMIT
    sent += drained(queue)
    for chunk in added:
        if sent.startswith(chunk):
            sent = sent[len(chunk) :]
    assert sent == b""
