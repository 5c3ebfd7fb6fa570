"""Lets the kernel drop what strangers send to a UDP socket, before it fills the socket's buffer.

In a flood the buffer overflows between two looks at it, and the autopilot's frames are lost with
the rest, however quickly the rest is thrown away here. A classic BPF program on the socket, which
needs no privilege on Linux, drops by source address and port as packets arrive. Elsewhere there is
no such thing, and nothing is filtered.

Source: Linux kernel documentation, "Linux Socket Filtering".
"""

from __future__ import annotations

import ctypes
import socket
import struct

from companion.mav.endpoint import Address

_SO_ATTACH_FILTER, _SO_DETACH_FILTER = 26, 27
_LOAD_HALF, _LOAD_WORD, _JUMP_EQUAL, _RETURN = 0x28, 0x20, 0x15, 0x06
_NETWORK_HEADER = 0xFFF00000
"""Where the IP header is; other offsets count from the UDP header."""
_SOURCE_ADDRESS, _SOURCE_PORT = 12, 0
_WHOLE, _NOTHING = 0xFFFFFFFF, 0


def hear_only(sock: socket.socket, peer: Address) -> bool:
    """Drop every datagram that is not from `peer`; whether the system can do that."""
    address = int.from_bytes(socket.inet_aton(peer[0]), "big")
    steps = (
        (_LOAD_HALF, 0, 0, _SOURCE_PORT),
        (_JUMP_EQUAL, 0, 3, peer[1]),
        (_LOAD_WORD, 0, 0, _NETWORK_HEADER + _SOURCE_ADDRESS),
        (_JUMP_EQUAL, 0, 1, address),
        (_RETURN, 0, 0, _WHOLE),
        (_RETURN, 0, 0, _NOTHING),
    )
    program = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *step) for step in steps))
    value = struct.pack("HL", len(steps), ctypes.addressof(program))
    try:
        sock.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, value)
    except OSError:
        return False
    return True


def hear_all(sock: socket.socket) -> None:
    """Take the filter away."""
    try:
        sock.setsockopt(socket.SOL_SOCKET, _SO_DETACH_FILTER, 0)
    except OSError:
        return  # there was none
