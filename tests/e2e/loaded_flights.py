"""Flights on a busy computer: real processes at real time, one without and one with a load.

The longest gap of the setpoint stream is the one that the simulator saw, between two setpoints that
came in OFFBOARD. It is as busy as the companion, whose own lateness of a tick is printed with it.
"""

from __future__ import annotations

import math
import os
import secrets
import socket
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from companion.domain import PositionEnu
from companion.io.child_processes import HOST, ChildProcess
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink, message_from_ranging
from companion.mav.signing import KEY_LENGTH, LinkSigning, Signing, SigningKey, timestamp_at
from sim_link.autopilot.scenario import PayloadParams
from sim_link.world.environment import Emitter, EmitterParams, FieldChannelParams
from sim_link.world.field_radio import FieldRadio
from tools.campaign.process_trials import ProcessFlight, story_of

FLIGHT_S = 120.0
"""Of half that a search has found its target."""
POSITIONS_ENU_M = ((50, 50), (80, 20), (20, 80), (80, 80), (60, 15), (15, 60), (90, 50), (50, 90))
EMITTERS = tuple(
    EmitterParams(number, position) for number, position in enumerate(POSITIONS_ENU_M, start=1)
)
RADIO_HZ, FLOOD_HZ = 1_000.0, 20_000.0
PROGRAMS_PER_CORE = 2
MAX_BEYOND_QUIET_S = 0.10
MAX_BUSY_GAP_S = 0.3
MAX_R95_RATIO = 1.05
"""Largest ratio of the estimate's R95 to that without the load: both errors are centimetres, which
is chance."""
RADIO_COMPONENT = mavlink.MAV_COMP_ID_PERIPHERAL + 1
FORGED = 1_000
"""Different forged frames."""
ENDLESS = ["-c", "while True: pass"]


MakeFrame = Callable[[int], bytes]
"""Returns a datagram by its number."""


class _Sender(threading.Thread):
    """Sends the datagrams that `make` returns at a rate, until it is stopped."""

    def __init__(self, port: int, rate_hz: float, make: MakeFrame) -> None:
        super().__init__(daemon=True)
        self._to, self._rate_hz, self._make = (HOST, port), rate_hz, make
        self._is_over = threading.Event()
        self.sent = 0

    def run(self) -> None:
        """Send what is due, a millisecond apart."""
        began_s = time.monotonic()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            while not self._is_over.wait(0.001):
                due = int(self._rate_hz * (time.monotonic() - began_s))
                for number in range(self.sent, due):
                    with suppress(OSError):
                        out.sendto(self._make(number), self._to)
                self.sent = due

    def stop(self) -> None:
        """Stop it, and wait for its end."""
        self._is_over.set()
        self.join()


class _Radio:
    """A MAVLink radio besides the payload: honest measurements of all emitters in turn."""

    def __init__(self, telemetry: socket.socket, seed: int) -> None:
        self._telemetry = telemetry
        telemetry.setblocking(False)
        rng = np.random.default_rng((seed, 0x12AD))
        self._radio = FieldRadio(FieldChannelParams(), rng, None, PayloadParams().antenna)
        self._emitters = [Emitter(params) for params in EMITTERS]
        self._codec = MavCodec(1, RADIO_COMPONENT)
        self._position: PositionEnu = (0.0, 0.0, 0.0)

    def frame(self, number: int) -> bytes:
        """Return a measurement from where the vehicle reported to be last."""
        with suppress(BlockingIOError):
            while True:
                for message in self._codec.decode(self._telemetry.recv(4096)):
                    if isinstance(message, mavlink.MAVLink_local_position_ned_message):
                        self._position = (message.y, message.x, -message.z)
        measured = self._radio.hear(
            self._emitters[number % len(self._emitters)], self._position, 0.0
        )
        return b"" if measured is None else self._codec.encode(message_from_ranging(measured, 0))


def _radio(telemetry: socket.socket, seed: int) -> MakeFrame:
    return _Radio(telemetry, seed).frame


def _forger(_telemetry: socket.socket, seed: int) -> MakeFrame:
    """Return a source of frames in the autopilot's name that are signed with another key."""
    rng = np.random.default_rng((seed, 0xF04))
    signing = Signing(SigningKey(rng.bytes(KEY_LENGTH)), timestamp_at(time.time()))
    codec = MavCodec(1, 1, LinkSigning(signing, 0))
    frames = []
    for number in range(FORGED):
        if number % 2:
            kind = (mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4)
            beat = mavlink.MAVLink_heartbeat_message(*kind, 0, 0, mavlink.MAV_STATE_EMERGENCY, 3)
            frames.append(codec.encode(beat))
        else:
            position = mavlink.MAVLink_local_position_ned_message(number, *rng.normal(0.0, 90.0, 6))
            frames.append(codec.encode(position))
    return lambda number: frames[number % FORGED]


@dataclass(frozen=True, slots=True)
class Load:
    """Load on a flight, and the longest gap allowed in its setpoint stream."""

    emitters: int = 1
    rate_hz: float = 0.0
    source: Callable[[socket.socket, int], MakeFrame] | None = None
    """Makes the datagrams that are sent to the companion at this rate, by telemetry and seed."""
    programs_per_core: int = 0
    """Programs of normal priority that never wait."""
    is_signed: bool = False
    most_gap_s: float | None = None
    """None: `MAX_BEYOND_QUIET_S` longer than without a load."""


LOADS = {
    "emitters": Load(emitters=len(EMITTERS)),
    "radio": Load(rate_hz=RADIO_HZ, source=_radio),
    "programs": Load(programs_per_core=PROGRAMS_PER_CORE, most_gap_s=MAX_BUSY_GAP_S),
    "flood": Load(rate_hz=FLOOD_HZ, source=_forger, is_signed=True),
}


@dataclass(frozen=True, slots=True)
class Flown:
    """A flight of real processes, by the simulator's report and the companion's log."""

    gap_s: float
    late_s: float
    """Worst lateness of a control tick by the companion's own clock."""
    is_kept: bool
    """True if OFFBOARD was entered and never left."""
    error_m: float
    """Horizontal, of the last estimate."""
    r95_m: float
    story: tuple[str, ...]


def _fly(seed: int, load: Load, duration_s: float) -> Flown:
    """Fly at real time under a load."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="load-")))
        telemetry = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        telemetry.bind((HOST, 0))
        flight = _start(folder, seed, load, telemetry.getsockname()[1])
        stack.callback(flight.close)
        flight.start_companion()
        if load.source is not None:
            sender = _Sender(flight.port, load.rate_hz, load.source(telemetry, seed))
            sender.start()
            stack.callback(sender.stop)
        for number in range(load.programs_per_core * (os.cpu_count() or 1)):
            program = ChildProcess(f"program {number}", ENDLESS, Path(os.devnull))
            program.start()
            stack.callback(program.stop)
        time.sleep(duration_s)
        report, events = flight.land(), flight.events.take()
    modes = [change["mode"] for change in report["mode_changes"]]
    last = [each for each in events if each["kind"] == "estimate"][-1]
    return Flown(
        gap_s=report["longest_setpoint_gap_s"],
        late_s=max((e["worst_late_s"] for e in events if e["kind"] == "process"), default=0.0),
        is_kept="offboard" in modes and modes[-1] == "offboard" and modes.count("offboard") == 1,
        error_m=math.dist(last["position_enu_m"], report["emitter"]["enu_m"][:2]),
        r95_m=last["absolute_r95_m"],
        story=story_of(events),
    )


def _start(folder: Path, seed: int, load: Load, telemetry_port: int) -> ProcessFlight:
    """Start the simulator of a flight, and write the configuration of its companion."""
    numbers = [each.emitter_id for each in EMITTERS]
    values: dict[str, object] = {"emitters": {"order": "listed", "listed": numbers}}
    options = ["--seed", str(seed), "--send-to", f"{HOST}:{telemetry_port}"]
    if load.is_signed:
        key, names = secrets.token_hex(KEY_LENGTH), ("companion.key", "simulator.key")
        for name in names:  # each remembers its timestamps beside its own
            (folder / name).write_text(key)
            (folder / name).chmod(0o600)
        values["link"] = {"signing_key_file": str(folder / names[0])}
        options += ["--signing-key", str(folder / names[1])]
    first, *others = msgspec.to_builtins(EMITTERS[: load.emitters])
    scenario = {"emitter": first, "emitters": others}
    return ProcessFlight(folder, "px4", 1.0, values, scenario, options)


@dataclass(frozen=True, slots=True)
class Compared:
    """A flight under a load and one without it."""

    quiet: Flown
    loaded: Flown
    findings: tuple[str, ...]


def fly_loaded(name: str, seed: int, duration_s: float) -> Compared:
    """Fly without and with the load, and compare."""
    load = LOADS[name]
    quiet = _fly(seed, Load(is_signed=load.is_signed), duration_s)
    loaded = _fly(seed, load, duration_s)
    findings = [] if loaded.is_kept else ["OFFBOARD was lost, or never entered"]
    most_s = load.most_gap_s or quiet.gap_s + MAX_BEYOND_QUIET_S
    if loaded.gap_s > most_s:
        findings.append(f"setpoints paused for {loaded.gap_s:.3f} s; {quiet.gap_s:.3f} s in quiet")
    if loaded.r95_m > MAX_R95_RATIO * quiet.r95_m:
        findings.append(f"R95 {loaded.r95_m:.3f} m; {quiet.r95_m:.3f} m in quiet")
    if loaded.error_m > loaded.r95_m:
        findings.append(f"estimate off by {loaded.error_m:.3f} m, R95 {loaded.r95_m:.3f} m")
    return Compared(quiet, loaded, tuple(findings))
