"""Rates of the simulator's streams at real time with three clients, and its reaction time.

Starts `sim-link` with a UDP port for two clients and a TCP port for one. Each client requests rates
of its own, and they are counted; then the first takes off, sends setpoints and counts the physics
steps until each is echoed. The simulator itself reports a setpoint's arrival: a TIMESYNC request
travels in the same datagram, so that scheduling delays of a client on a busy machine have no
effect. Prints two tables; exit code 0 when every rate is within 5 % and no setpoint waits longer
than one step, 1 otherwise.
"""

from __future__ import annotations

import math
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

from companion.entry import ignore_broken_pipe
from companion.io.child_processes import free_udp_ports
from companion.mav.dialect import Message, mavlink
from sim_link.lab.conformance.cli import open_link
from sim_link.lab.conformance.mavlink_oracle import LocalSetpoint, build_frame
from sim_link.lab.conformance.protocol_clients import SetpointClient
from sim_link.lab.conformance.rules import Flavour, NotApplicable, Violation
from tools.console import OneLineParser

ASKED_HZ: dict[type[Message], tuple[float, float, float]] = {
    mavlink.MAVLink_attitude_message: (50.0, 20.0, 10.0),
    mavlink.MAVLink_local_position_ned_message: (30.0, 50.0, 5.0),
    mavlink.MAVLink_global_position_int_message: (10.0, 25.0, 50.0),
    mavlink.MAVLink_attitude_quaternion_message: (25.0, 4.0, 12.5),
    mavlink.MAVLink_vfr_hud_message: (4.0, 10.0, 20.0),
    mavlink.MAVLink_gps_raw_int_message: (5.0, 2.0, 10.0),
    mavlink.MAVLink_sys_status_message: (2.0, 5.0, 4.0),
    mavlink.MAVLink_extended_sys_state_message: (2.0, 4.0, 5.0),
    mavlink.MAVLink_heartbeat_message: (1.0, 1.0, 1.0),
}
"""Rates that each client requests; HEARTBEAT is not requested."""
TOLERANCE = 0.05
TICK_MS = 20
SETPOINTS = 40
LANDING_S = 60.0
Echo = mavlink.MAVLink_position_target_local_ned_message
Clock = mavlink.MAVLink_timesync_message


@dataclass(frozen=True, slots=True)
class Rate:
    """One stream at one client."""

    client: int
    name: str
    asked_hz: float
    measured_hz: float

    @property
    def is_kept(self) -> bool:
        """Return True if the rate is within 5 %."""
        return abs(self.measured_hz / self.asked_hz - 1.0) <= TOLERANCE


def main(argv: Sequence[str] | None = None) -> int:
    """Count the messages of a simulator; return the exit code."""
    parser = OneLineParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument(
        "--autopilot", choices=[flavour.value for flavour in Flavour], default="px4"
    )
    parser.add_argument("--seconds", type=float, default=20.0, help="duration of the count")
    arguments = parser.parse_args(argv)
    with running_simulator(arguments.autopilot) as urls, ExitStack() as stack:
        links = [stack.enter_context(open_link(url)) for url in urls]
        try:
            return measure([SetpointClient(link) for link in links], arguments.seconds)
        except (NotApplicable, Violation) as problem:
            print(f"stream_rates: {problem}", file=sys.stderr)
            return 1


@contextmanager
def running_simulator(autopilot: str) -> Iterator[list[str]]:
    """Run a `sim-link` process at real time; yield the URLs of its three links."""
    udp, tcp, unused = free_udp_ports(3)
    command = [sys.executable, "-m", "sim_link", "--autopilot", autopilot, "--quiet"]
    command += ["--listen", f"127.0.0.1:{udp}", "--send-to", f"127.0.0.1:{unused}"]
    command += ["--link", f"tcpin:127.0.0.1:{tcp}", "--share-ports", "--stop-on-eof"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        try:
            yield [f"udpout:127.0.0.1:{udp}"] * 2 + [f"tcp:127.0.0.1:{tcp}"]
        finally:
            process.kill()


def measure(clients: Sequence[SetpointClient], seconds: float) -> int:
    """Run both measurements and return the exit code."""
    for client in clients:
        client.attach()
    clients[0].get_ready()
    rates = measure_rates(clients, seconds)
    print(f"{'client':>6}  {'stream':<24}{'asked':>8}{'measured':>10}")
    for rate in rates:
        mark = "" if rate.is_kept else "  FAILED"
        print(
            f"{rate.client:>6}  {rate.name:<24}{rate.asked_hz:>8.1f}{rate.measured_hz:>10.2f}{mark}"
        )
    steps = measure_reaction(clients[0])
    late = sum(1 for step in steps if step > 1)
    print("\nsteps of 20 ms from a setpoint to its echo")
    for step in sorted(set(steps)):
        print(f"{step:>6}  {steps.count(step)} times{'  FAILED' if step > 1 else ''}")
    return 0 if all(rate.is_kept for rate in rates) and not late else 1


def measure_rates(clients: Sequence[SetpointClient], seconds: float) -> list[Rate]:
    """Request the streams and count them at every client."""
    for number, client in enumerate(clients):
        for kind, wanted_hz in ASKED_HZ.items():
            if kind is not mavlink.MAVLink_heartbeat_message:
                client.set_interval(int(kind.id), 1.0 / wanted_hz[number])
    take_turns(clients, 1.0)
    marks = [client.mark for client in clients]
    take_turns(clients, seconds)
    return [
        Rate(
            number + 1,
            str(getattr(kind, "msgname", kind.__name__)),
            wanted_hz[number],
            rate_hz(client, kind, mark),
        )
        for number, (client, mark) in enumerate(zip(clients, marks, strict=True))
        for kind, wanted_hz in ASKED_HZ.items()
    ]


def take_turns(clients: Sequence[SetpointClient], seconds: float) -> None:
    """Let all clients read for a while."""
    until_s = time.monotonic() + seconds
    while time.monotonic() < until_s:
        for client in clients:
            client.run(0.002)


def rate_hz(client: SetpointClient, kind: type[Message], mark: int) -> float:
    """Return the rate of a message since a mark, from its first and last arrival."""
    times_s = [
        entry.time_s
        for entry in client.inbox[mark:]
        if isinstance(entry.message, kind) and entry.source == client.target
    ]
    passed_s = times_s[-1] - times_s[0] if len(times_s) > 1 else 0.0
    return (len(times_s) - 1) / passed_s if passed_s > 0.0 else 0.0


def measure_reaction(pilot: SetpointClient) -> list[int]:
    """Return the steps in flight from each setpoint's arrival to the echo that shows it."""
    pilot.take_off()
    north, east, down = pilot.position()
    stop = pilot.enter_offboard(LocalSetpoint((north, east, down)))
    pilot.set_interval(Echo, TICK_MS / 1e3)
    pilot.run(1.0)
    stop()
    steps = []
    for number in range(SETPOINTS):
        wanted = north + 1.0 + 0.1 * number
        pilot.run(0.05 + 0.001 * number)  # at any time between two steps
        mark = pilot.mark
        setpoint = LocalSetpoint((wanted, east, down)).message(pilot.target)
        clock = mavlink.MAVLink_timesync_message(0, number + 1)
        pilot.send_raw(b"".join(build_frame(each, pilot.spec()) for each in (setpoint, clock)))
        shown = pilot.expect(Echo, lambda m, wanted=wanted: abs(m.x - wanted) < 0.01, mark=mark)  # type: ignore[misc]
        answer = pilot.expect(Clock, lambda m, stamp=number + 1: m.ts1 == stamp, mark=mark)  # type: ignore[misc]
        steps.append(math.ceil((shown.time_boot_ms - answer.tc1 / 1e6) / TICK_MS))
    pilot.set_mode("land")
    pilot.await_disarmed(LANDING_S)
    return steps


if __name__ == "__main__":
    ignore_broken_pipe()
    sys.exit(main())
