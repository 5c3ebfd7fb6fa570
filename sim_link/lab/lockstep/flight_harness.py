"""Environment of a lockstep flight: the operator, and the checkpoints of its process.

Checkpoints are kept in memory, as the bytes that would be on disk, so that a test can damage them
between a kill and the next start.
"""

from __future__ import annotations

import math

from companion.domain import FlightMode
from companion.io.state import checkpoints
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Address, Chunk
from companion.mav.flight_modes import set_mode_params
from companion.mav.signing import LinkSigning
from companion.process.persistence import RestartKeeper
from sim_link.lab.lockstep.flight import Flight
from sim_link.lab.lockstep.observer import Lane, Observer

STATION_PEER: Address = ("127.0.0.1", 1)
COMPANION_COMPONENT = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER


class Operator:
    """A ground station with a link of its own to the vehicle, which no fault touches.

    It signs, from a Unix time at the start of the flight on, where the vehicle wants that.
    """

    def __init__(
        self, flight: Flight, signing: LinkSigning | None = None, started_unix_s: float = 0.0
    ) -> None:
        self._flight = flight
        self._signing = signing
        self._started_unix_s = started_unix_s
        self._station = MavCodec(255, mavlink.MAV_COMP_ID_MISSIONPLANNER, signing)

    def send(self, message: Message, peer: Address | None = STATION_PEER) -> None:
        """Send to the vehicle."""
        self._flight.sim.receive(Chunk(0, self._encoded(message), peer), self._flight.now_s)

    def command(self, number: int, *params: float) -> None:
        """Command the vehicle; parameters that are left out are NaN."""
        padded = [*params, *[math.nan] * (7 - len(params))]
        system = self._flight.scenario.system_id
        self.send(mavlink.MAVLink_command_long_message(system, 1, number, 0, *padded))

    def arm(self) -> None:
        """Ask to arm."""
        self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)

    def disarm(self) -> None:
        """Disarm by force, in the air too."""
        self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0.0, 21_196.0)

    def choose(self, mode: FlightMode) -> None:
        """Switch the mode."""
        flight = self._flight
        is_armed = flight.sim.vehicle.flavour.is_armed
        params = set_mode_params(mode, flight.autopilot, is_armed=is_armed)
        self.command(mavlink.MAV_CMD_DO_SET_MODE, *params)
        flight.note_chosen(mode)

    def grant(self) -> None:
        """Give control back to the companion, through the autopilot, which forwards it."""
        number, rest = mavlink.MAV_CMD_NAV_GUIDED_ENABLE, [0.0] * 6
        target = (self._flight.scenario.system_id, COMPANION_COMPONENT)
        message = mavlink.MAVLink_command_long_message(*target, number, 0, 1.0, *rest)
        self._flight.post(self._encoded(message), Lane.TO_COMPANION)

    def _encoded(self, message: Message) -> bytes:
        if self._signing is not None:
            self._signing.signing.advance(self._started_unix_s + self._flight.now_s)
        return self._station.encode(message)


MAX_AGE_S = 600.0


class MemoryStore:
    """Two generations of bytes."""

    def __init__(self) -> None:
        self.slots: dict[int, bytes] = {}

    def load(self) -> checkpoints.StoredCheckpoints:
        """Load the stored checkpoints."""
        whole, problems = [], []
        for number, data in self.slots.items():
            try:
                whole.append(checkpoints.decode_checkpoint(data))
            except checkpoints.CheckpointError as error:
                problems.append(f"slot {number}: {error}")
        newest = max(whole, key=lambda checkpoint: checkpoint.sequence, default=None)
        return checkpoints.StoredCheckpoints(bool(self.slots), newest, tuple(problems))

    def save(self, checkpoint: checkpoints.Checkpoint) -> None:
        """Keep a checkpoint in place of the older one."""
        self.slots[checkpoint.sequence % 2] = checkpoints.encode_checkpoint(checkpoint)

    def discard(self) -> None:
        """Forget both."""
        self.slots.clear()

    def close(self, timeout_s: float) -> None:
        """Do nothing: everything is kept already."""
        del timeout_s


class FlightClock:
    """A flight's time as a shell's clock."""

    speed = 1.0

    def __init__(self, flight: Flight) -> None:
        self._flight = flight

    def now_s(self) -> float:
        """Return the invented time, s."""
        return self._flight.now_s


class Checkpointing(Observer):
    """An observer that gives a flight's companion what a process has beside it.

    Each companion that is started takes up what the one before left, unless that is too old.
    """

    def __init__(self, flight: Flight, max_age_s: float = MAX_AGE_S) -> None:
        self.store = MemoryStore()
        self._flight = flight
        self._max_age_s = max_age_s
        self._begin()
        flight.observers.append(self)

    def _begin(self) -> None:
        flight = self._flight
        self._keeper = RestartKeeper(
            flight.companion,
            self.store,
            flight.config,
            FlightClock(flight),
            self._max_age_s,
            moment=lambda: checkpoints.Moment(flight.now_s, "lockstep", flight.now_s),
        )

    def companion_started(self, now_s: float) -> None:
        """Handle the start of another process."""
        del now_s
        self._begin()

    def companion_ended(self, now_s: float) -> None:
        """Handle the end of the companion, in order or not."""
        del now_s
        self._keeper.close(0.0)

    def ticked(self, now_s: float) -> None:
        """Run the tasks due at a wake-up."""
        self._keeper.run(now_s)
