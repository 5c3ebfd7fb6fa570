"""Words to the service manager that started us: ready, alive, stopping, and what we are doing.

The protocol is systemd's `sd_notify`: datagrams of `KEY=VALUE` lines to the socket named by
NOTIFY_SOCKET, a path or, with a leading `@`, a name in the abstract namespace. Nothing is sent
where the variable is not set. The socket never blocks: a manager that does not read costs words
and no time.

Source: sd_notify(3) and sd_watchdog_enabled(3).
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping

MICROSECONDS = 1e6
MAX_STATUS = 200


class Supervisor:
    """The service manager, or nobody.

    Args:
        environment: Of the process.
    """

    def __init__(self, environment: Mapping[str, str]) -> None:
        self.failed = 0
        """Words that could not be sent."""
        self.watchdog_s = _watchdog_s(environment)
        """Silence for longer than this is taken for death; None: nobody counts."""
        self._address = _address(environment.get("NOTIFY_SOCKET", ""))
        self._socket: socket.socket | None = None
        if self._address is not None:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)

    @property
    def is_there(self) -> bool:
        """Whether anybody wants to know."""
        return self._socket is not None

    def ready(self) -> None:
        """The links are open and the control tick runs."""
        self._say("READY=1")

    def alive(self) -> None:
        """Every part answered since the last time."""
        self._say("WATCHDOG=1")

    def status(self, text: str) -> None:
        """What we are doing, for `systemctl status`."""
        self._say(f"STATUS={' '.join(text.split())[:MAX_STATUS]}")

    def stopping(self) -> None:
        """We end."""
        self._say("STOPPING=1")

    def close(self) -> None:
        """Say nothing any more."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _say(self, words: str) -> None:
        if self._socket is None or self._address is None:
            return
        try:
            self._socket.sendto(words.encode("utf-8", errors="replace"), self._address)
        except OSError:
            self.failed += 1


def _address(text: str) -> bytes | None:
    if text.startswith("@") and len(text) > 1:
        return b"\0" + os.fsencode(text[1:])
    return os.fsencode(text) if text.startswith("/") else None


def _watchdog_s(environment: Mapping[str, str]) -> float | None:
    """WATCHDOG_USEC, if it is meant for this process."""
    microseconds, process = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID")
    if not (microseconds.isascii() and microseconds.isdigit() and int(microseconds) > 0):
        return None
    if process is not None and process != str(os.getpid()):
        return None
    return int(microseconds) / MICROSECONDS
