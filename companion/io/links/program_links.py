"""Links to programs of this computer: their output, standard input, and a pseudo terminal.

Theory of operation of a program. The shell runs it in a session of its own. A second shell beside
it reads a pipe from this process and ends the whole session when the pipe closes, which happens
when the link closes and also when this process is killed. The last line of its standard error says
why it ended. A program that ends is run again, later if it ended at once, whatever it printed; one
that is run periodically is meant to end. It counts as recovered once it has produced output for a
second, or has ended as it is meant to.

Theory of operation of a pseudo terminal, which other programs open as a serial port. This process
holds the master side; a link in the file system leads to the slave side. The master reports a
hang-up while no program has it open; this is polled twenty times a second, and output is dropped
until then, so that the next program never receives stale bytes.
"""

from __future__ import annotations

import asyncio
import os
import select
import shlex
import shutil
import stat
import subprocess
import threading
import tty
from contextlib import ExitStack
from pathlib import Path
from typing import IO

from companion.errors import LinkError
from companion.io.links.byte_streams import BACKOFF_MAX_S, BACKOFF_MIN_S, ByteStream, StreamLink
from companion.io.links.link import Link, Received, logger
from companion.mav.endpoint import Chunk

_KEEPER = """exec 3<&0 </dev/null
( trap '' TERM; cat <&3 >/dev/null; kill -TERM 0; sleep 1; kill -KILL 0 ) >/dev/null 2>&1 &
exec 3<&-
exec sh -c "$1"
"""
_SHELL_WORDS = frozenset(";|&(){}<>$=`\n")
EXIT_LOOK_S = 0.05
"""Time from the end of its output until a program is surely gone."""
LONGEST_NAME = 60
STEADY_S = 1.0
"""A program that talks for longer does not end at once."""


class ExecLink(Link):
    """Standard output of a program; with `period_s` it is run periodically, and ends each time."""

    def __init__(
        self, command: str, period_s: float | None, index: int, received: Received
    ) -> None:
        shown = command if len(command) <= LONGEST_NAME else f"{command[:LONGEST_NAME]}..."
        super().__init__(f"exec {shown}", index, received)
        self._command = command
        self._period_s = period_s
        self._process: subprocess.Popen[bytes] | None = None
        self._streams: list[ByteStream] = []
        self._timer: asyncio.TimerHandle | None = None
        self._pause_s = BACKOFF_MIN_S
        self._has_said = False
        self._started_s = 0.0
        self._complaint = ""
        self._is_closed = False

    @property
    def is_open(self) -> bool:
        """Return True while it runs or is to be run again."""
        return not self._is_closed

    async def open(self) -> None:
        """Run the program; raises a `LinkError` if it is missing, as far as that can be seen."""
        if not _SHELL_WORDS & set(self._command):
            program = next(iter(shlex.split(self._command)), "")
            if shutil.which(program) is None:
                raise LinkError(f"{self.name}: there is no program `{program}`")
        self._start()

    def close(self) -> None:
        """End the program and do not run it again."""
        self._is_closed = True
        if self._timer is not None:
            self._timer.cancel()
        self._release()

    def _start(self) -> None:
        self._timer = None
        self._has_said, self._complaint = False, ""
        self._started_s = asyncio.get_running_loop().time()
        try:
            process = subprocess.Popen(
                ["/bin/sh", "-c", _KEEPER, "sh", self._command],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                start_new_session=True,
            )
        except OSError as error:
            self._complaint = error.strerror or str(error)
            self._end()
            return
        threading.Thread(target=process.wait, name="exec", daemon=True).start()
        self._process = process
        self._streams = [
            self._stream(process.stdout, self._take, self._look_for_end),
            self._stream(process.stderr, self._complain, lambda _: None),
        ]

    def _stream(self, pipe: IO[bytes] | None, *callbacks: object) -> ByteStream:
        assert pipe is not None
        os.set_blocking(pipe.fileno(), False)
        return ByteStream(pipe, pipe.fileno(), *callbacks)  # type: ignore[arg-type]

    def _take(self, pieces: list[bytes]) -> None:
        self._has_said = True
        if asyncio.get_running_loop().time() - self._started_s >= STEADY_S:
            self._note_steady()
        self.counters.received += len(pieces)
        self._received([Chunk(self.index, piece, is_datagram=False) for piece in pieces])

    def _note_steady(self) -> None:
        self._pause_s = BACKOFF_MIN_S
        self._note_back()

    def _complain(self, pieces: list[bytes]) -> None:
        lines = b"".join(pieces)[-4096:].decode(errors="replace").split("\n")
        said = [line.strip() for line in lines if line.strip()]
        if said:
            self._complaint = "".join(c for c in said[-1] if c.isprintable())[:200]

    def _look_for_end(self, reason: str) -> None:
        """Handle the end of its output; a moment later its exit code is known."""
        del reason
        if not self._is_closed:
            self._timer = asyncio.get_running_loop().call_later(EXIT_LOOK_S, self._end)

    def _end(self) -> None:
        code = None if self._process is None else self._process.poll()
        self._release()
        is_meant = self._period_s is not None and self._has_said and code == 0
        if is_meant:
            self._note_steady()
        elif not self._is_lost:
            self._is_lost = True
            words = f"ended with {code}" if code is not None else "ended"
            reason = f"{words}: {self._complaint}" if self._complaint else words
            self.counters.last_error = reason
            logger.warning("%s: lost (%s); running it again", self.name, reason)
        if self.signals_loss:
            self._received([Chunk(self.index, b"", is_datagram=False)])
        pause_s = (self._period_s or 0.0) if is_meant else self._pause_s
        if not is_meant:
            self._pause_s = min(2.0 * self._pause_s, BACKOFF_MAX_S)
        self._timer = asyncio.get_running_loop().call_later(pause_s, self._start)

    def _release(self) -> None:
        """Close the pipes, on which the keeper ends what is left of the session."""
        for stream in self._streams:
            stream.close()
        self._streams = []
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()
        self._process = None


class StdinLink(StreamLink):
    """Standard input, a pipe or a terminal; the link ends with it."""

    def __init__(self, index: int, received: Received) -> None:
        super().__init__("stdin", index, received)

    async def open(self) -> None:
        """Begin to read."""
        try:
            mode = os.fstat(0).st_mode
            if not (stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode) or os.isatty(0)):
                raise LinkError(
                    "stdin: is no pipe and no terminal; of a file give file:PATH?play=1"
                )
            fd = os.dup(0)
            os.set_blocking(fd, False)
        except OSError as error:
            raise LinkError(f"stdin: cannot be read ({error.strerror})") from error
        self._use_stream(os.fdopen(fd, "rb", buffering=0), fd)


LOOK_S = 0.05


class PtyLink(StreamLink):
    """Pseudo terminal under a given path, for one program at a time."""

    def __init__(self, path: str, index: int, received: Received) -> None:
        super().__init__(f"pty {path}", index, received)
        self._path = Path(path)
        self._master: int | None = None
        self._look: asyncio.TimerHandle | None = None

    async def open(self) -> None:
        """Make the terminal and its name; raises a `LinkError` if the name cannot be made."""
        try:
            master, slave = os.openpty()
        except OSError as error:
            raise LinkError(f"{self.name}: no pseudo terminal to be had ({error})") from error
        try:
            tty.setraw(slave)
            if self._path.is_symlink() and not self._path.exists():
                self._path.unlink()  # left behind by a run that was killed
            self._path.symlink_to(os.ttyname(slave))
        except OSError as error:
            os.close(master)
            raise LinkError(f"{self.name}: {self._problem(error)}") from error
        finally:
            os.close(slave)
        os.set_blocking(master, False)
        self._master = master
        self._wait()

    def close(self) -> None:
        """Close the terminal and remove its name."""
        super().close()
        if self._look is not None:
            self._look.cancel()
            self._look = None
        if self._master is not None:
            self._path.unlink(missing_ok=True)
            os.close(self._master)
            self._master = None

    def _problem(self, error: OSError) -> str:
        if isinstance(error, FileExistsError):
            return "there is such a file already; delete it or choose another name"
        if not self._path.parent.is_dir():
            return f"there is no folder {self._path.parent}"
        return f"cannot be made ({error.strerror or error})"

    def _wait(self) -> None:
        """Check whether a program has opened the slave side, and check again in a moment if not."""
        self._look = None
        if self._master is None or self._is_closed:
            return
        watch = select.poll()
        watch.register(self._master, select.POLLIN)
        is_hung_up = any(events & select.POLLHUP for _, events in watch.poll(0))
        if is_hung_up:
            self._look = asyncio.get_running_loop().call_later(LOOK_S, self._wait)
        else:
            # the master outlives its streams: the next program to open the port uses the same one
            self._use_stream(ExitStack(), self._master)

    def _forget(self, reason: str) -> None:
        super()._forget(reason)
        self._wait()
