"""MAVSDK 4, an independent MAVLink stack, connected to a running simulator."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Callable
from contextlib import aclosing, asynccontextmanager
from typing import Any

from mavsdk.asyncio import ComponentType, Configuration, Mavsdk, System
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.offboard import OffboardAsync
from mavsdk.asyncio.plugins.param import ParamAsync
from mavsdk.asyncio.plugins.telemetry import LandedState, TelemetryAsync

from tests.e2e.simulator_process import PATIENCE_S, running_simulator

SPEED = 6.0


class Client:
    """One vehicle and the plugins that fly it."""

    def __init__(self, system: System, flavour: str) -> None:
        self.system = system
        self.flavour = flavour
        self.action = ActionAsync(system)
        self.telemetry = TelemetryAsync(system)
        self.offboard = OffboardAsync(system)
        self.param = ParamAsync(system)

    async def ask_for_streams(self) -> None:
        """Request the streams of MAVSDK's health and positions; an ArduPilot sends on request."""
        await self.telemetry.set_rate_health(2.0)
        await self.telemetry.set_rate_home(1.0)
        await self.telemetry.set_rate_position(10.0)
        await self.telemetry.set_rate_position_velocity_ned(10.0)
        await self.telemetry.set_rate_landed_state(5.0)

    async def get_ready(self) -> None:
        """Wait until it can be armed and knows its home."""
        if self.flavour == "ardupilot":
            await self.ask_for_streams()
            # STABILIZE can be armed long before GUIDED has a position
            await until(self.telemetry.subscribe_position_velocity_ned(), lambda _: True)
        await until(
            self.telemetry.subscribe_health(),
            lambda health: health.is_armable and health.is_home_position_ok,
        )

    async def take_off(self) -> None:
        """Arm and climb; wait for the height."""
        await self.get_ready()
        await self.action.arm()
        await until(self.telemetry.subscribe_armed(), bool)
        await self.action.takeoff()
        await until(self.telemetry.subscribe_landed_state(), is_in_air)

    async def await_ground(self) -> None:
        """Wait until it has landed and disarmed."""
        await until(self.telemetry.subscribe_armed(), lambda is_armed: not is_armed)


def is_in_air(state: Any) -> bool:
    """Return True if a landed state is IN_AIR."""
    return bool(state == LandedState.IN_AIR)


class Heard:
    """Updates of a subscription since it began, read in order."""

    def __init__(self) -> None:
        self._updates: asyncio.Queue[Any] = asyncio.Queue()

    async def listen(self, updates: AsyncGenerator[Any, None]) -> None:
        """Keep every update."""
        async with aclosing(updates):
            async for update in updates:
                self._updates.put_nowait(update)

    async def until(self, condition: Callable[[Any], bool]) -> Any:
        """The next update that meets a condition."""
        async with asyncio.timeout(PATIENCE_S):
            while not condition(update := await self._updates.get()):
                pass
        return update


@asynccontextmanager
async def heard_from_now(updates: AsyncGenerator[Any, None]) -> AsyncIterator[Heard]:
    """Subscribe from here on: a short state may be over before it is asked for.

    A generator of MAVSDK subscribes when it is first read.
    """
    heard = Heard()
    listening = asyncio.create_task(heard.listen(updates))
    await asyncio.sleep(0)  # the task runs up to its first wait, and has subscribed then
    try:
        yield heard
    finally:
        listening.cancel()
        await asyncio.gather(listening, return_exceptions=True)


async def until(updates: AsyncGenerator[Any, None], condition: Callable[[Any], bool]) -> Any:
    """The first update that meets a condition."""
    async with asyncio.timeout(PATIENCE_S), aclosing(updates):
        async for update in updates:
            if condition(update):
                return update
    raise AssertionError("the updates ended")


@asynccontextmanager
async def connected(port: int, flavour: str) -> AsyncIterator[Client]:
    """The first autopilot heard on a UDP port."""
    configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
    async with Mavsdk(configuration) as mavsdk:
        await mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        system = await mavsdk.first_autopilot(timeout_s=PATIENCE_S)
        assert system is not None
        yield Client(system, flavour)


def fly(flavour: str, flight: Callable[[Client], Any]) -> None:
    """Run a flight against a simulator of its own."""

    async def run(port: int) -> None:
        async with connected(port, flavour) as client:
            await flight(client)

    with running_simulator(flavour, SPEED, bears_s=60.0) as port:
        asyncio.run(run(port))
