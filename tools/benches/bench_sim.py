"""Simulated vehicles at real time on one core: `python tools/benches/bench_sim.py [N]`.

Every vehicle flies a velocity setpoint streamed at 10 Hz, with its default streams; the frames are
built and handed out, and a shell would only send them. Printed is the processor time per simulated
second; under 1 it is faster than real time.
"""

from __future__ import annotations

import sys
import time

from companion.entry import ignore_broken_pipe
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Chunk
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.pilot import STEP_S
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from sim_link.fleet.vehicles import Fleet

SECONDS = 10
WARM_UP_S = 12
SETPOINT_EVERY = 5


def command(system_id: int, number: int, *params: float) -> Message:
    """Return a COMMAND_LONG, unused parameters 0."""
    padded = [*params, *[0.0] * (7 - len(params))]
    return mavlink.MAVLink_command_long_message(system_id, 1, number, 0, *padded)


class Flight:
    """Vehicles in the air that follow setpoints.

    Args:
        count: Number of vehicles.
        flavour: Autopilot of all of them.
    """

    def __init__(self, count: int, flavour: FlavourName) -> None:
        self.count, self.is_px4 = count, flavour == "px4"
        autopilot = AutopilotParams(flavour=flavour)
        self.fleet = Fleet(
            [SimEndpoint(Scenario(system_id=n + 1, autopilot=autopilot), n) for n in range(count)],
            links_each=1,
        )
        self._sender = MavCodec(255, 190)
        self._step = 0
        self.frames = 0

    def send(self, vehicle: int, message: Message) -> None:
        """Send to one vehicle."""
        data = self._sender.encode(message)
        self.fleet.receive(Chunk(vehicle, data, ("127.0.0.1", 1)), self._step * STEP_S)

    def take_off(self) -> None:
        """Bring all of them into the air and into the mode that follows setpoints."""
        self.run(3, streams=False)
        for n in range(self.count):
            if not self.is_px4:
                self.send(n, command(n + 1, mavlink.MAV_CMD_DO_SET_MODE, 1.0, 4.0))
            self.send(n, command(n + 1, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0))
            height_m = 498.0 if self.is_px4 else 10.0
            self.send(n, command(n + 1, mavlink.MAV_CMD_NAV_TAKEOFF, *[0.0] * 6, height_m))
            for number in (32, 33, 30):
                ask = (float(number), 1e5 if number != 32 else 5e4)
                self.send(n, command(n + 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, *ask))
        self.run(8, streams=False)
        self.run(1, streams=True)
        for n in range(self.count):
            if self.is_px4:
                self.send(n, command(n + 1, mavlink.MAV_CMD_DO_SET_MODE, 1.0, 6.0))
        self.run(WARM_UP_S - 11, streams=True)

    def run(self, seconds: int, *, streams: bool) -> None:
        """Let simulated time pass."""
        for _ in range(round(seconds / STEP_S)):
            self._step += 1
            if streams and self._step % SETPOINT_EVERY == 0:
                for n in range(self.count):
                    self.send(n, setpoint(n + 1))
            self.fleet.handle_timer(self._step * STEP_S)
            self.frames += len(self.fleet.take_output())


def setpoint(system_id: int) -> Message:
    """Return a setpoint that climbs slowly to the north."""
    fields = [0.0] * 3 + [1.0, 0.0, -0.1] + [0.0] * 5
    return mavlink.MAVLink_set_position_target_local_ned_message(
        0, system_id, 1, mavlink.MAV_FRAME_LOCAL_NED, 0x0DC7, *fields
    )


def main() -> None:
    """Fly a fleet of each flavour, and print the share of a core."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 50
    flavours: tuple[FlavourName, ...] = ("px4", "ardupilot")
    for flavour in flavours:
        flight = Flight(count, flavour)
        flight.take_off()
        flying = sum(not e.vehicle.body.is_on_ground for e in flight.fleet.endpoints)
        before, started_s = flight.frames, time.process_time()
        flight.run(SECONDS, streams=True)
        share = (time.process_time() - started_s) / SECONDS
        frames = (flight.frames - before) / SECONDS
        print(
            f"{flavour}: {count} vehicles ({flying} flying), {frames:.0f} frames/s: "
            f"{share:.2f} s of one core per simulated second; real time for {count / share:.0f}"
        )


if __name__ == "__main__":
    ignore_broken_pipe()
    main()
