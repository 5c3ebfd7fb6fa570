"""The operator flown through MAVSDK: arm, take off, switch modes, come home, land."""

from __future__ import annotations

import asyncio
import json
from contextlib import aclosing, suppress
from pathlib import Path
from typing import Any

from companion.domain import Autopilot, FlightMode
from companion.errors import CompanionError, ConfigError, how_to_install
from companion.link.autopilot_queries import STREAM_INTERVAL_S
from companion.mav.dialect import mavlink
from companion.mav.flight_modes import set_mode_params
from sim_link.lab.mission.steps import Action, Request, TakeOffAction

SEARCH_S = 30.0
"""Real time that an autopilot may take to be found."""
COMPANION = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER
ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
POSITION_RATE_HZ = 1.0 / STREAM_INTERVAL_S[mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED]
"""The companion's: on a link that it shares with us a lower one would starve it."""


def check_installed() -> None:
    """Make sure that MAVSDK is there; `ConfigError` says how to get it."""
    try:
        import mavsdk.asyncio  # noqa: F401  only whether it is there
    except ImportError as error:
        text = f"real processes need MAVSDK: {how_to_install('mavsdk')}"
        raise ConfigError(text) from error


class MavsdkOperator:
    """A `MissionOperator`: a ground station on a UDP port of this machine."""

    def __init__(self, port: int, log: Path) -> None:
        self._port = port
        self._log = log
        self._mavsdk: Any = None
        self._action: Any = None
        self._direct: Any = None
        self._system_id = 1
        self._task: asyncio.Task[None] | None = None
        self._watch: asyncio.Task[None] | None = None
        self._refusal: str | None = None
        self.is_ready = False
        """True if the autopilot can be armed and knows its home."""
        self.is_heard = False
        self.autopilot = Autopilot.OTHER
        """Set by the observer of the vehicle: mode numbers differ between autopilots."""
        self.is_armed = False
        """Set by the observer of the vehicle."""

    async def __aenter__(self) -> MavsdkOperator:
        from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
        from mavsdk.logging import log_subscribe

        log_subscribe(self._note)
        configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
        self._mavsdk = Mavsdk(configuration)
        await self._mavsdk.__aenter__()
        await self._mavsdk.add_any_connection(f"udpin://127.0.0.1:{self._port}")
        self._watch = asyncio.create_task(self._find())
        return self

    async def __aexit__(self, *_: object) -> None:
        tasks = [task for task in (self._watch, self._task) if task is not None]
        for task in tasks:
            task.cancel()
        for task in tasks:
            with suppress(asyncio.CancelledError, Exception):
                await task
        await self._mavsdk.__aexit__(None, None, None)

    def _note(self, level: Any, message: str, *_: object) -> bool:
        """Keep a remark of MAVSDK's, which then prints nothing."""
        with suppress(OSError), self._log.open("a", encoding="utf-8") as file:
            file.write(f"{level.name} {message}\n")
        return True

    def ask(self, action: Action) -> None:
        """Begin a request; the previous one is forgotten."""
        if self._task is not None and not self._task.done():
            return  # still at it: MAVSDK repeats by itself
        self._task = asyncio.create_task(self._do(action))

    def take_refusal(self) -> str | None:
        """Take the reason of the last refusal; None: not refused."""
        refusal, self._refusal = self._refusal, None
        return refusal

    async def _find(self) -> None:
        """Find the autopilot and begin to watch it; `CompanionError`: there is none."""
        from mavsdk.asyncio.plugins.action import ActionAsync
        from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync
        from mavsdk.asyncio.plugins.telemetry import TelemetryAsync

        system = await self._mavsdk.first_autopilot(timeout_s=SEARCH_S)
        if system is None:
            raise CompanionError("MAVSDK found no autopilot")
        self._system_id = await system.get_system_id()
        while not self.is_heard:
            await asyncio.sleep(0.01)
        self._action = ActionAsync(system)
        self._direct = MavlinkDirectAsync(system)
        telemetry = TelemetryAsync(system)
        if self.autopilot is Autopilot.ARDUPILOT:
            await _ask_for_streams(telemetry)
        async with aclosing(telemetry.subscribe_health()) as updates:
            async for health in updates:
                self.is_ready = bool(health.is_armable and health.is_home_position_ok)

    async def _do(self, action: Action) -> None:
        if self._action is None:
            self._refusal = "MAVSDK has not found the autopilot yet"
            return
        try:
            await self._carry_out(action)
        except Exception as error:  # MAVSDK's errors have no common base
            self._refusal = f"MAVSDK: {error}"

    async def _carry_out(self, action: Action) -> None:
        match action:
            case Request.ARM:
                if self.autopilot is Autopilot.ARDUPILOT:  # elsewhere it wants the throttle low
                    await self._switch(FlightMode.OFFBOARD)
                await self._action.arm()
            case TakeOffAction():
                await self._action.set_takeoff_altitude(action.height_m)
                await self._action.takeoff()
            case Request.GRANT:
                await self._command(COMPANION, mavlink.MAV_CMD_NAV_GUIDED_ENABLE, (1.0,))
            case FlightMode.RETURN:
                await self._action.return_to_launch()
            case FlightMode.LAND:
                await self._action.land()
            case FlightMode() if self.autopilot is Autopilot.OTHER:
                raise CompanionError("only modes of PX4 and ArduPilot are known")
            case FlightMode():
                await self._switch(action)

    async def _switch(self, mode: FlightMode) -> None:
        params = set_mode_params(mode, self.autopilot, is_armed=self.is_armed)
        number = mavlink.MAV_CMD_DO_SET_MODE
        await self._command(mavlink.MAV_COMP_ID_AUTOPILOT1, number, params)

    async def _command(self, component: int, number: int, params: tuple[float, ...]) -> None:
        """Send a COMMAND_LONG and wait for its answer; `CompanionError`: it was refused."""
        from mavsdk.asyncio.plugins.mavlink_direct import MavlinkMessage

        padded = [*params, *[0.0] * (7 - len(params))]
        fields = {
            "target_system": self._system_id,
            "target_component": component,
            "command": number,
            "confirmation": 0,
        } | {f"param{index}": value for index, value in enumerate(padded, 1)}
        message = MavlinkMessage(
            message_name="COMMAND_LONG",
            system_id=0,
            component_id=0,
            target_system_id=self._system_id,
            target_component_id=component,
            fields_json=json.dumps(fields),
        )
        answer = await self._direct.send_command(message)
        result = json.loads(answer.fields_json).get("result")
        if result != ACCEPTED:
            raise CompanionError(f"command {number} was refused with result {result}")


async def _ask_for_streams(telemetry: Any) -> None:
    """Request the streams of MAVSDK's health and positions; ArduPilot sends none unasked."""
    await telemetry.set_rate_health(2.0)
    await telemetry.set_rate_home(1.0)
    await telemetry.set_rate_position(2.0)
    await telemetry.set_rate_position_velocity_ned(POSITION_RATE_HZ)
    await telemetry.set_rate_landed_state(2.0)
