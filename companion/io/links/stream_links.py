"""Links by byte streams: listening TCP ports, programs, standard input, pseudo terminals.

A TCP port listens for one client, or for several. A client is a peer by its address and port; each
is a byte stream of its own, so that an endpoint keeps the unfinished frames of different clients
apart.

Theory of operation of a program. The shell runs it in a session of its own. A second shell next to
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
import socket
import stat
import subprocess
import threading
import tty
from abc import abstractmethod
from contextlib import ExitStack
from pathlib import Path
from typing import IO

from companion.errors import LinkError
from companion.io.links.byte_streams import (
    BACKOFF_MAX_S,
    BACKOFF_MIN_S,
    ByteStream,
    StreamLink,
    has_frame,
    tune,
)
from companion.io.links.link import Link, Received, bind_problem, bound_address, logger
from companion.io.links.udp import resolve
from companion.mav.endpoint import Address, Chunk

MAX_CLIENTS = 16
BACKLOG = 4


class TcpListener(Link):
    """Listening TCP port; subclasses decide what happens to a client."""

    def __init__(self, host: str, port: int, index: int, received: Received) -> None:
        super().__init__(f"tcpin {host}:{port}", index, received)
        self._host, self._port = host, port
        self._listener: socket.socket | None = None

    @property
    def local_address(self) -> Address:
        """Host and port of the open socket; `("", 0)` while closed."""
        return bound_address(self._listener)

    async def open(self) -> None:
        """Bind and listen."""
        address = await resolve(self.name, self._host, self._port)
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            # For TCP this only skips the wait for old connections; a taken port still fails.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
            listener.listen(BACKLOG)
        except OSError as error:
            listener.close()
            raise LinkError(bind_problem("tcp", self._host, self._port, error)) from error
        listener.setblocking(False)
        self._listener = listener
        asyncio.get_running_loop().add_reader(listener, self._accept)

    @abstractmethod
    def _objection(self) -> str | None:
        """Return the reason why another client must be refused; None if it is accepted."""

    @abstractmethod
    def _welcome(self, client: socket.socket, peer: Address) -> None:
        """Accept a client."""

    def _accept(self) -> None:
        if self._listener is None:
            return
        try:
            client, (host, port) = self._listener.accept()
        except OSError:  # the client left again, or no descriptors are left
            self.counters.receive_errors += 1
            return
        objection = self._objection()
        if objection is not None:
            logger.info("%s: %s rejected, %s", self.name, host, objection)
            client.close()
            return
        client.setblocking(False)
        tune(client)
        self._welcome(client, (str(host), int(port)))

    def _close_port(self) -> None:
        if self._listener is not None:
            asyncio.get_running_loop().remove_reader(self._listener)
            self._listener.close()
            self._listener = None


class TcpServerLink(TcpListener, StreamLink):
    """Listening TCP port that serves one client at a time; others are refused."""

    def _objection(self) -> str | None:
        return None if self._stream is None else "one client at a time"

    def _welcome(self, client: socket.socket, peer: Address) -> None:
        del peer
        self._use_stream(client, client.fileno())

    def close(self) -> None:
        """Close the client and the port."""
        super().close()
        self._close_port()


class TcpFanOutLink(TcpListener):
    """TCP port for 16 clients; a new one takes the oldest slot that never sent MAVLink."""

    def __init__(self, host: str, port: int, index: int, received: Received) -> None:
        super().__init__(host, port, index, received)
        self._clients: dict[Address, ByteStream] = {}
        self._proved: set[Address] = set()
        """Clients that sent a MAVLink frame."""

    @property
    def clients(self) -> tuple[Address, ...]:
        """Connected clients, in the order of their connection."""
        return tuple(self._clients)

    def send(self, chunk: Chunk) -> None:
        """Send to the chunk's peer, or to all clients if it names none."""
        if chunk.peer is not None:
            self._write(self._clients.get(chunk.peer), chunk.data)
            return
        for peer, client in list(self._clients.items()):
            if peer not in chunk.except_peers:
                self._write(client, chunk.data)

    def close(self) -> None:
        """Close all clients and the port."""
        for client in self._clients.values():
            client.close()
        self._clients.clear()
        self._close_port()

    def _write(self, client: ByteStream | None, data: bytes) -> None:
        if client is not None and client.write(data):
            self.counters.sent += 1
        else:
            self.counters.dropped += 1

    def _objection(self) -> str | None:
        if len(self._clients) < MAX_CLIENTS:
            return None
        stranger = next((peer for peer in self._clients if peer not in self._proved), None)
        if stranger is None or not self.expects_mavlink:
            return f"{MAX_CLIENTS} clients at most"
        self._clients[stranger].close()
        self._forget(stranger, "it never sent MAVLink")
        return None

    def _welcome(self, client: socket.socket, peer: Address) -> None:
        logger.info("%s: %s:%d connected", self.name, *peer)
        self._clients[peer] = ByteStream(
            client,
            client.fileno(),
            lambda pieces: self._take(peer, pieces),
            lambda reason: self._forget(peer, reason),
        )

    def _take(self, peer: Address, pieces: list[bytes]) -> None:
        self.counters.received += len(pieces)
        if peer not in self._proved and has_frame(pieces):
            self._proved.add(peer)
        self._received([Chunk(self.index, piece, peer, is_datagram=False) for piece in pieces])

    def _forget(self, peer: Address, reason: str) -> None:
        self._clients.pop(peer, None)
        self._proved.discard(peer)
        self.counters.send_errors += reason != "closed by the other end"
        logger.info("%s: %s:%d lost (%s)", self.name, *peer, reason)
        self._received([Chunk(self.index, b"", peer, is_datagram=False)])


_KEEPER = """exec 3<&0 </dev/null
( trap '' TERM; cat <&3 >/dev/null; kill -TERM 0; sleep 1; kill -KILL 0 ) >/dev/null 2>&1 &
exec 3<&-
exec sh -c "$1"
"""
_SHELL_WORDS = frozenset(";|&(){}<>$=`\n")
EXIT_CHECK_S = 0.05
"""Time from the end of its output until a program is surely gone."""
LONGEST_NAME = 60
STEADY_S = 1.0
"""Time after which a program that ends has not ended at once."""


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
        self._error_text = ""
        self._is_closed = False

    @property
    def is_open(self) -> bool:
        """Return True while it runs or is to be run again."""
        return not self._is_closed

    async def open(self) -> None:
        """Run the program; raises a `LinkError` if it is visibly missing."""
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
        self._has_said, self._error_text = False, ""
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
            self._error_text = error.strerror or str(error)
            self._end()
            return
        threading.Thread(target=process.wait, name="exec", daemon=True).start()
        self._process = process
        self._streams = [
            self._stream(process.stdout, self._take, self._look_for_end),
            self._stream(process.stderr, self._keep_error, lambda _: None),
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

    def _keep_error(self, pieces: list[bytes]) -> None:
        lines = b"".join(pieces)[-4096:].decode(errors="replace").split("\n")
        said = [line.strip() for line in lines if line.strip()]
        if said:
            self._error_text = "".join(c for c in said[-1] if c.isprintable())[:200]

    def _look_for_end(self, reason: str) -> None:
        """Handle the end of its output; a moment later its exit code is known."""
        del reason
        if not self._is_closed:
            self._timer = asyncio.get_running_loop().call_later(EXIT_CHECK_S, self._end)

    def _end(self) -> None:
        code = None if self._process is None else self._process.poll()
        self._release()
        is_meant = self._period_s is not None and self._has_said and code == 0
        if is_meant:
            self._note_steady()
        elif not self._is_lost:
            self._is_lost = True
            words = f"ended with {code}" if code is not None else "ended"
            reason = f"{words}: {self._error_text}" if self._error_text else words
            self.counters.last_error = reason
            logger.warning("%s: lost (%s); running it again", self.name, reason)
        if self.signals_loss:
            self._received([Chunk(self.index, b"", is_datagram=False)])
        pause_s = (self._period_s or 0.0) if is_meant else self._pause_s
        if not is_meant:
            self._pause_s = min(2.0 * self._pause_s, BACKOFF_MAX_S)
        self._timer = asyncio.get_running_loop().call_later(pause_s, self._start)

    def _release(self) -> None:
        """Close the pipes, so that the keeper ends the rest of the session."""
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
                    "stdin: neither a pipe nor a terminal; for a file use file:PATH?play=1"
                )
            fd = os.dup(0)
            os.set_blocking(fd, False)
        except OSError as error:
            raise LinkError(f"stdin: cannot be read ({error.strerror})") from error
        self._use_stream(os.fdopen(fd, "rb", buffering=0), fd)


CHECK_S = 0.05


class PtyLink(StreamLink):
    """Pseudo terminal under a given path, for one program at a time."""

    def __init__(self, path: str, index: int, received: Received) -> None:
        super().__init__(f"pty {path}", index, received)
        self._path = Path(path)
        self._master: int | None = None
        self._look: asyncio.TimerHandle | None = None

    async def open(self) -> None:
        """Create the terminal and its path; raises a `LinkError` if the path cannot be created."""
        try:
            master, slave = os.openpty()
        except OSError as error:
            raise LinkError(f"{self.name}: no pseudo terminal is available ({error})") from error
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
            return "the file exists already; delete it or choose another name"
        if not self._path.parent.is_dir():
            return f"there is no folder {self._path.parent}"
        return f"cannot be created ({error.strerror or error})"

    def _wait(self) -> None:
        """Poll until a program has opened the slave side."""
        self._look = None
        if self._master is None or self._is_closed:
            return
        watch = select.poll()
        watch.register(self._master, select.POLLIN)
        is_hung_up = any(events & select.POLLHUP for _, events in watch.poll(0))
        if is_hung_up:
            self._look = asyncio.get_running_loop().call_later(CHECK_S, self._wait)
        else:
            # the master outlives its streams: the next program to open the port uses the same one
            self._use_stream(ExitStack(), self._master)

    def _forget(self, reason: str) -> None:
        super()._forget(reason)
        self._wait()
