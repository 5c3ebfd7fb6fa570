"""Listening clients of tools/bench_process.py: they receive everything and do nothing with it.

    .venv/bin/python tools/benches/listeners.py mavsdk|pymavlink PORT

It imports nothing of this project, whose modules would count as memory of the libraries.
"""

from __future__ import annotations

import asyncio
import importlib
import sys
from collections.abc import AsyncIterator
from contextlib import suppress
from typing import Any


def listen_by_pymavlink(port: str) -> None:
    """Receive all messages with `recv_match`."""
    mavutil: Any = importlib.import_module("pymavlink.mavutil")
    link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}")
    while True:
        link.recv_match(blocking=True)


async def listen_by_mavsdk(port: str) -> None:
    """Subscribe to the messages of a small app."""
    from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
    from mavsdk.asyncio.plugins.telemetry import TelemetryAsync

    settings = Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER)
    async with Mavsdk(settings) as mavsdk:
        await mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        telemetry = TelemetryAsync(await mavsdk.first_autopilot(30.0))
        streams = (
            telemetry.subscribe_position(),
            telemetry.subscribe_attitude_euler(),
            telemetry.subscribe_health(),
        )
        await asyncio.gather(*map(exhaust, streams))


async def exhaust(stream: AsyncIterator[object]) -> None:
    """Read a stream for ever."""
    async for _ in stream:
        pass


if __name__ == "__main__":
    with suppress(KeyboardInterrupt):
        if sys.argv[1] == "mavsdk":
            asyncio.run(listen_by_mavsdk(sys.argv[2]))
        listen_by_pymavlink(sys.argv[2])
