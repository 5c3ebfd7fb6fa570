"""Random frames with a valid checksum, and signature where there is a key, against the companion.

Half of the fields are random bytes, half are numbers that make more sense and do more harm. They
come from the autopilot's own ids and address, because nobody else is listened to.
"""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from companion.config.schema import CompanionConfig
from companion.guidance.session_params import SessionParams
from companion.mav.codec import CRC_EXTRA_BY_ID
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Chunk
from companion.mav.framing import frame_crc
from companion.mav.signing import Signing, timestamp_at
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from sim_link.campaign.flights import Monitored, monitored
from sim_link.campaign.signed import KEY, STARTED_UNIX_S
from sim_link.campaign.trial import Outcome, Trial, trial_seed
from sim_link.lockstep.flight import VEHICLE_PEER

FRAMES_PER_TRIAL = 20_000
PER_TICK = 10
SLOWEST_FRAME_S = 0.05
MOST_GROWTH_MB = 24.0
SIGNED_LINK = 9
HEARD: tuple[type[Message], ...] = (
    mavlink.MAVLink_heartbeat_message,
    mavlink.MAVLink_local_position_ned_message,
    mavlink.MAVLink_global_position_int_message,
    mavlink.MAVLink_attitude_message,
    mavlink.MAVLink_sys_status_message,
    mavlink.MAVLink_battery_status_message,
    mavlink.MAVLink_extended_sys_state_message,
    mavlink.MAVLink_home_position_message,
    mavlink.MAVLink_gps_global_origin_message,
    mavlink.MAVLink_gps_raw_int_message,
    mavlink.MAVLink_estimator_status_message,
    mavlink.MAVLink_command_ack_message,
    mavlink.MAVLink_command_long_message,
    mavlink.MAVLink_command_int_message,
    mavlink.MAVLink_statustext_message,
    mavlink.MAVLink_timesync_message,
    mavlink.MAVLink_param_value_message,
    mavlink.MAVLink_mission_count_message,
    mavlink.MAVLink_mission_item_int_message,
    mavlink.MAVLink_position_target_local_ned_message,
    mavlink.MAVLink_position_target_global_int_message,
    mavlink.MAVLink_rc_channels_message,
    mavlink.MAVLink_landing_target_message,
    mavlink.MAVLink_ranging_beacon_message,
    mavlink.mavlink_map[45010],
)
"""What a companion acts on; some frames are of any message of the dialect."""
SPECIAL = (np.nan, np.inf, -np.inf, 0.0, -0.0, 1e30, -1.0, 1.0, 1e-42)


class FrameMaker:
    """Makes frames of the autopilot.

    Args:
        rng: Where all of it comes from.
        signing: Signs them; None: unsigned.
    """

    def __init__(self, rng: np.random.Generator, signing: Signing | None) -> None:
        self._rng = rng
        self._signing = signing
        self._all = list(mavlink.mavlink_map.values())
        self._sequence = 0

    def next(self) -> bytes:
        """The next frame."""
        rng = self._rng
        kinds = HEARD if rng.random() < 0.85 else self._all
        kind = kinds[int(rng.integers(len(kinds)))]
        payload = self._payload(int(kind.unpacker.size)).rstrip(b"\0") or b"\0"
        self._sequence = (self._sequence + 1) % 256
        number = int(kind.id)
        head = bytes((0xFD, len(payload), 0, 0, self._sequence, 1, 1)) + number.to_bytes(
            3, "little"
        )
        frame = head + payload
        frame += frame_crc(frame, CRC_EXTRA_BY_ID[number]).to_bytes(2, "little")
        if self._signing is None:
            return frame
        return self._signing.sign(frame, SIGNED_LINK, CRC_EXTRA_BY_ID[number])

    def _payload(self, size: int) -> bytes:
        rng = self._rng
        if rng.random() < 0.5:
            return rng.bytes(size)
        payload = bytearray(size)
        for start in range(0, size - 3, 4):
            draw = rng.random()
            if draw < 0.5:
                value = SPECIAL[int(rng.integers(len(SPECIAL)))]
                payload[start : start + 4] = np.float32(value).tobytes()
            elif draw < 0.8:
                payload[start] = int(rng.integers(16))
            else:
                payload[start : start + 4] = np.float32(rng.normal(0.0, 100.0)).tobytes()
        return bytes(payload)


class Fuzzing:
    """The part of the campaign that sends random frames."""

    name = "fuzz"
    title = "random frames with valid checksum and signature"

    def trials(self, amount: float, seed: int) -> Sequence[Trial]:
        """So many frames."""
        count = -(-round(amount) // FRAMES_PER_TRIAL)
        size = amount / count / FRAMES_PER_TRIAL
        return [Trial(self.name, trial_seed(seed, index), size) for index in range(count)]

    def cost(self, trial: Trial) -> float:
        """Seconds of one core."""
        return 5.0 * trial.size

    def run(self, trial: Trial) -> Outcome:
        """Feed a companion that begins anew every so often, so that it is in every phase.

        What the process has loaded is put aside from garbage collection, as the companion's own
        process does before it flies.
        """
        gc.collect()
        gc.freeze()
        try:
            return self._run(trial)
        finally:
            gc.unfreeze()

    def _run(self, trial: Trial) -> Outcome:
        rng = np.random.default_rng((trial.seed, 0xF022))
        is_signed = bool(trial.seed % 2)
        signing = Signing(KEY, timestamp_at(STARTED_UNIX_S)) if is_signed else None
        maker = FrameMaker(rng, signing)
        slowest_s, sent, reached, findings = 0.0, 0, 0, list[str]()
        settled_mb: float | None = None
        while sent < trial.size * FRAMES_PER_TRIAL:
            around = _flight(trial.seed + sent, is_signed=is_signed)
            around.flight.run(float(rng.uniform(0.0, 20.0)))
            for _ in range(round(trial.size * FRAMES_PER_TRIAL / 4 / PER_TICK)):
                if signing is not None:
                    signing.advance(STARTED_UNIX_S + around.flight.now_s)
                for _ in range(PER_TICK):
                    frame = maker.next()
                    began_s = time.thread_time()
                    around.flight.companion.receive(
                        Chunk(0, frame, VEHICLE_PEER), around.flight.now_s
                    )
                    slowest_s = max(slowest_s, time.thread_time() - began_s)
                    sent += 1
                around.flight.run(0.05)
            findings += [str(v) for v in around.monitor.violations if v.invariant in JUDGED]
            reached += 1
            if reached == 2:
                settled_mb = resident_mb()
        grown_mb = resident_mb() - (settled_mb or 0.0)
        if slowest_s > SLOWEST_FRAME_S:
            findings.append(f"a frame took {slowest_s:.3f} s")
        if grown_mb > MOST_GROWTH_MB:
            findings.append(f"memory grew by {grown_mb:.1f} MB")
        return Outcome(
            trial,
            tuple(findings),
            sums={"fuzz_frames": float(sent)},
            most={"fuzz_slowest_frame_s": slowest_s, "fuzz_growth_mb": max(0.0, grown_mb)},
        )


JUDGED = ("I6", "I8", "I9", "I11")
"""Invariants that hold whatever a vehicle says; the others need one that tells the truth."""


def _flight(seed: int, *, is_signed: bool) -> Monitored:
    flavour: FlavourName = "px4" if seed % 4 < 2 else "ardupilot"
    config = CompanionConfig(mission=SessionParams(engage="auto", stop_confirm_s=1e6))
    scenario = Scenario(autopilot=AutopilotParams(flavour=flavour))
    return monitored(config, scenario, seed, is_signed=is_signed)


def resident_mb() -> float:
    """Resident memory of this process."""
    fields = Path("/proc/self/statm").read_text(encoding="ascii").split()
    return int(fields[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
