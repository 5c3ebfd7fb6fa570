"""Ports of this machine that are a test's own until its process ends.

A port that is picked by binding 0 and closing again is not reserved: the system may assign it to
the next socket, of another worker for instance, before the process that it was picked for is there.
Those below the system's own range are never handed out, and a name in the abstract namespace, which
vanishes with its process, keeps other tests of this machine away.
"""

from __future__ import annotations

import random
import socket
from contextlib import closing

_HOST = "127.0.0.1"
_FIRST, _END = 20_000, 32_000
"""Below what Linux hands out by itself (`net.ipv4.ip_local_port_range`)."""
_dice = random.SystemRandom()
"""Not the one that tests give a seed."""
_reservations: list[int] = []
"""Descriptors; the system closes them at the end of the process."""


def free_port() -> int:
    """Return a port that is free for UDP and TCP, and that no other test takes."""
    for _ in range(_END - _FIRST):
        port = _dice.randrange(_FIRST, _END)
        if _reserve(port) and _is_free(port):
            return port
    raise AssertionError("no port is free")


def _reserve(port: int) -> bool:
    reservation = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        reservation.bind(f"\0companion-test-port-{port}")
    except OSError:
        reservation.close()
        return False
    _reservations.append(reservation.detach())
    return True


def _is_free(port: int) -> bool:
    for kind in (socket.SOCK_DGRAM, socket.SOCK_STREAM):
        with closing(socket.socket(socket.AF_INET, kind)) as probe:
            try:
                probe.bind((_HOST, port))
            except OSError:
                return False
    return True
