"""Files that are read whole: nothing but a regular file, or a pipe with a writer, is waited for."""

from __future__ import annotations

import errno
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from companion.config.area_files import read_fence
from companion.config.schema import load_config
from companion.config.search_files import read_search_site
from companion.errors import ConfigError
from companion.flight_setup import open_flight
from companion.io import files
from companion.io.checkpoints import FILE, CheckpointStore, kept_offsets
from companion.io.files import FLIGHT, open_file
from companion.io.mcap_file import read_mcap_flight
from companion.io.radio_recording import is_radio_recording, read_radio_recording
from companion.io.state_directory import load_signing_key
from companion.replay.walk_replay import read_walk

NO_WRITER = "a pipe that nothing is written to"


@contextmanager
def no_wait() -> Iterator[None]:
    """Raise where the block waits for ever."""

    def give_up(_number: int, _frame: object) -> None:
        """End the wait."""
        raise AssertionError("waits for a writer")

    earlier = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(10)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, earlier)


READERS: dict[str, Callable[[Path], object]] = {
    "site.yaml": load_config,
    "walk.csv": read_walk,
    "walk.json": lambda path: read_walk(path.with_suffix(".csv")),
    "site.plan": read_fence,
    "site.kml": read_search_site,
    "site.tif": read_search_site,
    "flight.mcap": read_mcap_flight,
    FLIGHT: lambda path: open_flight(path.parent),
    "signing.key": load_signing_key,
    "radio.jsonl": read_radio_recording,
    FILE: lambda path: kept_offsets(path.parent),
}


@pytest.mark.parametrize("name", READERS)
def test_a_pipe_without_a_writer_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / name)
    with no_wait(), pytest.raises(ConfigError) as refused:
        READERS[name](tmp_path / name)
    assert str(refused.value).startswith(f"{tmp_path / name}: ")
    assert NO_WRITER in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_pipe_among_the_saved_state_does_not_keep_a_start_waiting(tmp_path: Path) -> None:
    store = CheckpointStore(tmp_path, "udp")
    os.mkfifo(store.paths[0])
    with no_wait():
        assert NO_WRITER in store.load().problems[0]
        assert not is_radio_recording(store.paths[0])


def test_a_pipe_with_a_writer_is_read_to_its_end() -> None:
    """As of `<(sed ... site.yaml)`, whose first byte comes late."""
    read_end, write_end = os.pipe()
    content = b"link:\n  unsigned_ranging: true\n" + 100_000 * b"#"

    def write() -> None:
        """Write it in pieces, more than a pipe holds."""
        with open(write_end, "wb") as pipe:
            pipe.write(content)

    writer = threading.Timer(0.05, write)
    writer.start()
    with no_wait(), open_file(Path(f"/dev/fd/{read_end}")) as file:
        assert file.read() == content
    writer.join()
    os.close(read_end)


@pytest.mark.parametrize("written", [b"", b"emitter"])
def test_of_a_pipe_whose_writer_has_ended_the_rest_is_read(written: bytes) -> None:
    read_end, write_end = os.pipe()
    os.write(write_end, written)
    os.close(write_end)
    path = Path(f"/dev/fd/{read_end}")
    with no_wait():
        if written:
            assert open_file(path).read() == written
        else:
            with pytest.raises(OSError, match=NO_WRITER):
                open_file(path)
    os.close(read_end)


def test_a_pipe_without_an_end_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "MAX_PIPED_BYTES", 10)
    read_end, write_end = os.pipe()
    os.write(write_end, b"y" * 5000)
    with no_wait(), pytest.raises(OSError, match="save it as a file") as refused:
        open_file(Path(f"/dev/fd/{read_end}"))
    assert refused.value.errno == errno.EFBIG
    os.close(read_end)
    os.close(write_end)


@pytest.mark.parametrize("written", [b"", b"emitter"])
def test_a_pipe_that_its_writer_holds_open_is_given_up(
    written: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As `/dev/stdin` of a program that is started by another one."""
    monkeypatch.setattr(files, "MAX_SILENCE_S", 0.0)
    read_end, write_end = os.pipe()
    os.write(write_end, written)
    with no_wait(), pytest.raises(OSError, match="silent for a minute; give a file"):
        open_file(Path(f"/dev/fd/{read_end}"))
    os.close(read_end)
    os.close(write_end)


def test_a_device_is_no_file_but_the_null_device_is_an_empty_one() -> None:
    main, line = os.openpty()
    with no_wait():
        for name in ("/dev/zero", os.ttyname(line)):
            with pytest.raises(OSError, match="a device"):
                open_file(Path(name))
        assert open_file(Path(os.devnull)).read() == b""
    os.close(main)
    os.close(line)
