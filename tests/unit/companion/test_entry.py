"""Standard output and error whose reader has gone away."""

from __future__ import annotations

import fcntl
import io
import os
import shlex
import signal
import subprocess
import sys
import termios
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from companion.entry import ignore_broken_pipe
from companion.errors import printable


@contextmanager
def read_output(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """The descriptor on which this process's standard output is read."""
    read_end, write_end = os.pipe()
    with os.fdopen(write_end, "w", encoding="ascii", errors="backslashreplace") as own:
        monkeypatch.setattr(sys, "stdout", own)
        monkeypatch.setattr(sys, "__stdout__", own)
        ignore_broken_pipe()
        yield read_end
        monkeypatch.undo()
    with suppress(OSError):
        os.close(read_end)


def test_what_is_read_arrives_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    with read_output(monkeypatch) as reader:
        sys.stdout.write("range \N{GREEK SMALL LETTER RHO}\n")
        sys.stdout.flush()
        assert os.read(reader, 100) == b"range \\u03c1\n"
        assert not sys.stdout.isatty()


def test_unread_output_is_dropped_and_nothing_is_raised(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with read_output(monkeypatch) as reader:
        os.close(reader)
        sys.stdout.write("a line\n" * 10_000)
        sys.stdout.buffer.write(b"bytes")
        sys.stdout.flush()


def test_a_stream_that_replaced_it_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    other = io.StringIO()
    monkeypatch.setattr(sys, "stdout", other)
    ignore_broken_pipe()
    assert sys.stdout is other


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_line_arrives_at_once_however_python_buffers(unbuffered: str) -> None:
    code = (
        "from companion.entry import ignore_broken_pipe; import os, sys; "
        "ignore_broken_pipe(escapes=True)"
    )
    code += '; print("address", file=sys.stderr); os.write(2, b"later")'
    environment = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, env=environment)
    assert done.stderr == b"address\nlater"


def test_a_process_without_output_can_write_afterwards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", None)
    ignore_broken_pipe()
    assert sys.stdout is not None
    sys.stdout.write("")


FOREIGN = "a\x1b[2Jb\x9b1mc\u202ed\rOK\u2028e\x07\x00 \u00e9\t\n"
SHOWN = "a\\x1b[2Jb\\x9b1mc\\u202ed\\rOK\\u2028e\\x07\\x00 \u00e9\t\n"


def test_control_characters_of_foreign_texts_are_shown_and_not_obeyed() -> None:
    assert printable(FOREIGN) == SHOWN


def run(
    command: str, tmp_path: Path, environment: dict[str, str] | None = None
) -> subprocess.CompletedProcess[bytes]:
    """Run a shell line in which `companion` is this interpreter's."""
    program = f'companion() {{ {shlex.quote(sys.executable)} -m companion "$@"; }}; {command}'
    env = {**os.environ, "NUMBA_DISABLE_JIT": "1", **(environment or {})}
    return subprocess.run(
        ["bash", "-c", program], cwd=tmp_path, env=env, capture_output=True, timeout=60.0
    )


def test_what_a_file_has_of_terminal_commands_is_printed_escaped(tmp_path: Path) -> None:
    name = "sit\x1b]0;owned\x07e\u202e.yaml"
    (tmp_path / name).write_text("emitters: {order: fast}", encoding="utf-8")
    (tmp_path / "keys.yaml").write_text('"a\\e[2Jb\\u202e": 1\n', encoding="utf-8")
    (tmp_path / "walk.csv").write_text("\x1b[2Jtime,\x9bwhat\n1,\x1b[31m\n", encoding="utf-8")
    for command in (
        f"companion config show --config {shlex.quote(name)}",
        "companion config show --config keys.yaml",
        f"companion report {shlex.quote(name)}",
        "companion replay walk.csv",
        "companion --connect $'udp:\\e[2Jhost:x'",
        "companion $'--\\e[2Jwhat'",
    ):
        done = run(command, tmp_path)
        assert done.returncode == 2, (command, done)
        text = (done.stdout + done.stderr).decode("utf-8")
        assert text.strip()
        assert printable(text) == text, (command, text)


CLOSED = [">&-", "2>&-", ">&- 2>&-", "<&- >&- 2>&-", "| true", "2>&1 | true", "> /dev/null <&-"]


COMMANDS = {
    "companion config schema": 0,
    "companion config show --config none.yaml": 2,
    "companion config show": 0,
    "companion --help": 0,
    "companion --version": 0,
    "companion radio list": 0,
}
LONG, REFUSED, *OTHERS = COMMANDS
"""A long output, and one on standard error, with every redirection; the others with one."""


@pytest.mark.parametrize(
    ("command", "redirection"),
    [
        *((command, each) for command in (LONG, REFUSED) for each in CLOSED),
        *zip(OTHERS, 2 * (">&- 2>&-", "2>&1 | true"), strict=True),
    ],
)
def test_closed_streams_are_quiet_and_the_exit_code_is_the_same(
    tmp_path: Path, command: str, redirection: str
) -> None:
    code = COMMANDS[command]
    done = run(f"set -o pipefail; {command} {redirection}", tmp_path)
    assert done.returncode == code
    assert b"Traceback" not in done.stderr
    assert b"Exception" not in done.stderr
    assert len(done.stderr.splitlines()) <= (code == 2)


def test_a_full_disk_under_the_output_is_one_line_and_a_failed_run(tmp_path: Path) -> None:
    for command in ("companion config show", "companion --help"):
        done = run(f"{command} > /dev/full", tmp_path)
        assert done.returncode == 1
        assert done.stderr == b"companion: standard output: No space left on device\n"
    assert run("companion config show --config none.yaml 2> /dev/full", tmp_path).returncode == 2


def test_a_termination_ends_a_command_with_one_line(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "walk.csv")
    command = [sys.executable, "-m", "companion", "replay", "walk.csv"]
    pipe = os.open(tmp_path / "walk.csv", os.O_RDWR)
    os.write(pipe, bytes(fcntl.fcntl(pipe, fcntl.F_GETPIPE_SZ)))
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE) as replay:
        os.write(pipe, b"\n")  # has room once the command reads
        while fcntl.ioctl(pipe, termios.FIONREAD, bytes(4)) != bytes(4):
            pass
        replay.send_signal(signal.SIGTERM)
        _, said = replay.communicate(timeout=60.0)
    os.close(pipe)
    assert (replay.returncode, said) == (1, b"companion: interrupted\n")


def test_without_a_home_state_is_never_in_a_shared_folder(tmp_path: Path) -> None:
    done = run(
        "unset HOME XDG_STATE_HOME STATE_DIRECTORY; companion --connect udp:127.0.0.1:29541",
        tmp_path,
    )
    assert done.returncode == 2
    assert done.stderr.count(b"\n") == 1
    assert b"process.state_directory: there is no HOME" in done.stderr
