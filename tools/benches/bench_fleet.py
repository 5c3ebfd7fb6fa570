"""Number of vehicles that one `sim-link` process flies at real time over UDP, on one core.

Starts `sim-link --vehicles N`, arms all of them, lets them take off and streams setpoints at 10 Hz
to each, which has rates of its own; their default streams go to an unused port. Then it counts the
messages that return. It prints the processor time of the process, its waiting time for a core
(Linux only), the lag of the vehicles' clocks and streams, and whether that is real time. If not, it
tries fewer vehicles until it is; on a machine that is too busy for a verdict, none. Exit code 0
when N held real time, 1 when not, 2 for bad arguments.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from companion.entry import ignore_broken_pipe
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from sim_link.lab.conformance.mavlink_oracle import cut
from sim_link.lab.conformance.rules import Flavour
from tools.benches.bench_sim import command, setpoint
from tools.console import OneLineParser, positive

POSITION_ID = mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED
ASKED_HZ = 20.0
TOLERANCE = 0.05
MAX_LAG_S = 0.2
SETPOINT_PERIOD_S = 0.1
BOOT_S, CLIMB_S, SETTLE_S = 5.0, 6.0, 2.0
RECEIVE_BUFFER = 1 << 24
FULL = 0.9
"""Largest load of a core: more leaves no time to be late and catch up."""
FEWER = 0.85
"""Ratio of the next number of vehicles to one that was too large."""
MAX_WAITING = 0.1
"""Largest share of the time spent waiting for a core; above it the machine is busy."""


@dataclass(slots=True)
class Track:
    """Positions received from one vehicle."""

    count: int = 0
    first_ms: int = 0
    last_ms: int = 0

    def take(self, boot_ms: int) -> None:
        """Count a LOCAL_POSITION_NED."""
        if self.count == 0:
            self.first_ms = boot_ms
        self.count += 1
        self.last_ms = boot_ms

    @property
    def simulated_s(self) -> float:
        """Simulated time that passed for the vehicle, s."""
        return (self.last_ms - self.first_ms) / 1e3


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result for a number of vehicles."""

    count: int
    flying: int
    core_share: float
    waiting_share: float
    frames_hz: float
    lag_s: float
    worst_rate_hz: float

    @property
    def holds(self) -> bool:
        """Return True if every vehicle held real time."""
        slow = self.worst_rate_hz < (1.0 - TOLERANCE) * ASKED_HZ
        return self.flying == self.count and self.lag_s <= MAX_LAG_S and not slow

    @property
    def verdict(self) -> str:
        """Return the verdict.

        At real time with the number of vehicles that an idle core has room for.
        """
        if not self.holds:
            return "NOT real time"
        return f"real time; by this a core has room for {self.count * FULL / self.core_share:.0f}"

    def line(self, flavour: str) -> str:
        """Return the result as a line of text."""
        return (
            f"{flavour}: {self.count} vehicles ({self.flying} flying), {self.frames_hz:.0f} "
            f"frames/s heard: {self.core_share:.2f} of one core, {self.waiting_share:.2f} waiting; "
            f"lag {1e3 * self.lag_s:.0f} ms, slowest stream {self.worst_rate_hz:.1f} of "
            f"{ASKED_HZ:.0f} Hz: {self.verdict}"
        )


class Crowd:
    """One socket that sends to each vehicle, and receives from all of them.

    Args:
        first_port: Port of the first vehicle; the others count up.
        count: Number of vehicles.
        is_px4: Their flavour.
    """

    def __init__(self, first_port: int, count: int, *, is_px4: bool) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        self._socket.settimeout(0.005)
        self._first = first_port
        self._count, self._is_px4 = count, is_px4
        self._codec = MavCodec(255, 190)
        self._next_setpoint_s: float | None = None
        self.tracks: dict[int, Track] = {}
        self.armed: set[int] = set()
        self.frames = 0

    def __enter__(self) -> Crowd:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def send_all(self, number: int, *params: float) -> None:
        """Send a COMMAND_LONG to every vehicle."""
        for n in range(self._count):
            self._send(n, command(n + 1, number, *params))

    def take_off(self) -> None:
        """Bring all of them into the air and into the mode that follows setpoints."""
        time.sleep(BOOT_S)
        if not self._is_px4:
            self.send_all(mavlink.MAV_CMD_DO_SET_MODE, 1.0, 4.0)
        self.send_all(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, float(POSITION_ID), 1e6 / ASKED_HZ)
        self.send_all(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
        height_m = 498.0 if self._is_px4 else 10.0
        self.send_all(mavlink.MAV_CMD_NAV_TAKEOFF, *[0.0] * 6, height_m)
        self.listen(CLIMB_S)
        self._next_setpoint_s = time.monotonic()
        self.listen(SETTLE_S)
        if self._is_px4:
            self.send_all(mavlink.MAV_CMD_DO_SET_MODE, 1.0, 6.0)
        self.listen(SETTLE_S)

    def listen(self, seconds: float) -> None:
        """Receive for a while, and send the setpoints that are due."""
        until_s = time.monotonic() + seconds
        while (now_s := time.monotonic()) < until_s:
            if self._next_setpoint_s is not None and now_s >= self._next_setpoint_s:
                self._next_setpoint_s = max(self._next_setpoint_s + SETPOINT_PERIOD_S, now_s)
                for n in range(self._count):
                    self._send(n, setpoint(n + 1))
            try:
                self._read(self._socket.recv(65535))
            except TimeoutError:
                continue

    def begin_again(self) -> None:
        """Reset the counts."""
        self.tracks.clear()
        self.armed.clear()
        self.frames = 0

    def _send(self, vehicle: int, message: Message) -> None:
        address = ("127.0.0.1", self._first + vehicle)
        self._socket.sendto(self._codec.encode(message), address)

    def _read(self, data: bytes) -> None:
        for frame in cut(data):
            self.frames += 1
            system, component, number = frame[5], frame[6], int.from_bytes(frame[7:10], "little")
            if component != mavlink.MAV_COMP_ID_AUTOPILOT1:
                continue
            if number == POSITION_ID:
                boot_ms = int.from_bytes(frame[10:14], "little")
                self.tracks.setdefault(system, Track()).take(boot_ms)
            elif number == mavlink.MAVLINK_MSG_ID_HEARTBEAT and frame[16] & 0x80:
                self.armed.add(system)


def main(argv: Sequence[str] | None = None) -> int:
    """Fly the fleets and print their cost; return the exit code."""
    parser = OneLineParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--vehicles", metavar="N", type=positive, default=50, help="(default 50)")
    parser.add_argument("--seconds", metavar="S", type=positive, default=15, help="(default 15)")
    parser.add_argument("--port", type=positive, default=24_000, help="first port (default 24000)")
    parser.add_argument(
        "--autopilot",
        choices=[flavour.value for flavour in Flavour],
        help="only this one (default: one after the other)",
    )
    arguments = parser.parse_args(argv)
    chosen = [arguments.autopilot] if arguments.autopilot else [each.value for each in Flavour]
    held = []
    for flavour in chosen:
        outcome = measure(flavour, arguments.vehicles, arguments.seconds, arguments.port)
        print(outcome.line(flavour), flush=True)
        held.append(outcome.holds)
        while not outcome.holds and outcome.count > 1 and outcome.waiting_share <= MAX_WAITING:
            fewer = max(1, int(FEWER * outcome.count))
            outcome = measure(flavour, fewer, arguments.seconds, arguments.port)
            print(outcome.line(flavour), flush=True)
        if not outcome.holds:
            print(f"{flavour}: the machine is too busy for a verdict", flush=True)
    return 0 if all(held) else 1


def measure(flavour: str, count: int, seconds: int, port: int) -> Outcome:
    """Fly a number of vehicles and count."""
    with (
        Crowd(port, count, is_px4=flavour == Flavour.PX4.value) as crowd,
        running(flavour, count, port) as pid,
    ):
        crowd.take_off()
        crowd.begin_again()
        began_s, before = time.monotonic(), used_and_waited_s(pid)
        crowd.listen(seconds)
        passed_s, after = time.monotonic() - began_s, used_and_waited_s(pid)
    tracks = crowd.tracks.values()
    complete = len(crowd.tracks) == count
    step_s = 1.0 / ASKED_HZ
    return Outcome(
        count,
        len(crowd.armed),
        (after[0] - before[0]) / passed_s,
        (after[1] - before[1]) / passed_s,
        crowd.frames / passed_s,
        max((passed_s - step_s - track.simulated_s for track in tracks), default=passed_s),
        min((track.count / passed_s for track in tracks), default=0.0) if complete else 0.0,
    )


@contextmanager
def running(flavour: str, count: int, port: int) -> Iterator[int]:
    """Run the process under test; yield its id."""
    arguments = [sys.executable, "-m", "sim_link", "--autopilot", flavour, "--quiet"]
    arguments += ["--vehicles", str(count), "--listen", f"127.0.0.1:{port}"]
    arguments += ["--send-to", f"127.0.0.1:{port + count}", "--stop-on-eof"]
    with subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        try:
            yield process.pid
        finally:
            process.kill()


def used_and_waited_s(pid: int) -> tuple[float, float]:
    """Return the seconds that a process was on a core, and ready without one."""
    used_ns, waited_ns, _ = Path(f"/proc/{pid}/schedstat").read_text(encoding="ascii").split()
    return int(used_ns) / 1e9, int(waited_ns) / 1e9


if __name__ == "__main__":
    ignore_broken_pipe()
    sys.exit(main())
