"""Link over a pseudo terminal, which other programs open as a serial port.

This process holds the master side; a link in the file system leads to the slave side. The master
reports a hang-up while no program has it open; this is polled twenty times a second, and output is
dropped until then, so that the next program never receives stale bytes.
"""

from __future__ import annotations

import asyncio
import os
import select
import tty
from contextlib import ExitStack
from pathlib import Path

from companion.errors import LinkError
from companion.io.links.byte_streams import StreamLink
from companion.io.links.link import Received

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
