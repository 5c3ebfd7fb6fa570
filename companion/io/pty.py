"""A serial port without hardware: a pseudo terminal with a name of our choosing.

Theory of operation. We hold the terminal's master side; a link in the file system leads to the
slave side, which any program opens as a serial port. The master reports a hang-up while nobody has
the slave open; that is looked at twenty times a second, and until somebody comes what we send is
dropped, as on a line that leads nowhere, so whoever opens it hears nothing stale.
"""

from __future__ import annotations

import asyncio
import os
import select
import tty
from pathlib import Path

from companion.errors import LinkError
from companion.io.link_base import Received
from companion.io.streams import StreamLink

LOOK_S = 0.05


class _Kept:
    """A descriptor that outlives the streams on it."""

    def close(self) -> None:
        """Leave it open: the next to open the port comes by the same master."""


class PtyLink(StreamLink):
    """A pseudo terminal under a given path, for one program at a time."""

    def __init__(self, path: str, index: int, received: Received) -> None:
        super().__init__(f"pty {path}", index, received)
        self._path = Path(path)
        self._master: int | None = None
        self._look: asyncio.TimerHandle | None = None

    async def open(self) -> None:
        """Make the terminal and its name.

        Raises:
            LinkError: The name is taken, or its folder is missing or closed to us.
        """
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
        """Look whether somebody has opened the slave side, and again in a moment if not."""
        self._look = None
        if self._master is None or self._is_closed:
            return
        watch = select.poll()
        watch.register(self._master, select.POLLIN)
        is_hung_up = any(events & select.POLLHUP for _, events in watch.poll(0))
        if is_hung_up:
            self._look = asyncio.get_running_loop().call_later(LOOK_S, self._wait)
        else:
            self._connected(_Kept(), self._master)

    def _forget(self, reason: str) -> None:
        super()._forget(reason)
        self._wait()
