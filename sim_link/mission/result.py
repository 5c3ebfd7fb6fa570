"""One flight of a mission with its verdicts."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass

from companion.io.files import plain
from companion.io.logs.log_files import tlog_record
from sim_link.mission.record import FlightRecord
from sim_link.mission.script import Mission
from sim_link.mission.verdicts import Verdict, true_places

EPOCH_S = 946_684_800.0
"""2000-01-01 in Unix time: an invented clock has no date, and readers of tlogs want one."""


MAX_SLUG = 80
"""Characters; a file name has two of these and may have 255 in all."""


def slug(name: str) -> str:
    """A mission's name as part of a file name, cut to `MAX_SLUG`."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-")[:MAX_SLUG].strip("-") or "mission"


def flight_name(mission: str, flavour: str, how: str, seed: int) -> str:
    """What the files and the folder of a flight are called, without an ending."""
    return f"{slug(mission)}-{flavour}-{slug(how)}-seed{seed}"


def how_flown(speed: float | None, connect: str | None) -> str:
    """`lockstep`, `speed 4`, or the link to a vehicle that is not ours.

    Args:
        speed: Times real time, with real processes; None: lockstep.
        connect: The vehicle's link; None: it is a simulated one.
    """
    if connect is not None:
        return connect
    return "lockstep" if speed is None else f"speed {speed:g}"


@dataclass(frozen=True, slots=True)
class MissionResult:
    """What a run came to; can be sent between processes."""

    mission: Mission
    file: str
    seed: int
    how: str
    """See `how_flown`."""
    record: FlightRecord
    verdicts: tuple[Verdict, ...]

    @property
    def is_passed(self) -> bool:
        """Whether every expectation is met, and every step done."""
        return all(verdict.is_met for verdict in self.verdicts)

    @property
    def failed(self) -> list[Verdict]:
        """Those that are not met."""
        return [verdict for verdict in self.verdicts if not verdict.is_met]

    @property
    def title(self) -> str:
        """What reports call it."""
        return f"{self.mission.name} ({self.flavour}), seed {self.seed}"

    @property
    def flight_name(self) -> str:
        """What its files are called, without an ending."""
        return flight_name(self.mission.name, self.flavour, self.how, self.seed)

    @property
    def flavour(self) -> str:
        """Whose autopilot was flown."""
        return self.record.autopilot or self.mission.autopilot.flavour

    @property
    def final_error_m(self) -> float | None:
        """Of the last estimate of the first emitter."""
        emitter = self.mission.emitter.emitter_id
        point = self.record.last_estimate(emitter)
        if point is None:
            return None
        return math.dist(point.position_enu_m, true_places(self.mission)[emitter])

    @property
    def is_inside_r95(self) -> bool | None:
        """Whether the true emitter is within R95 of the last estimate."""
        point = self.record.last_estimate(self.mission.emitter.emitter_id)
        error_m = self.final_error_m
        return None if point is None or error_m is None else error_m <= point.r95_m

    @property
    def tlog(self) -> bytes:
        """The frames as a `.tlog`, at times since 2000; empty where a file was written instead."""
        records = (tlog_record(frame, EPOCH_S + time_s) for time_s, frame in self.record.frames)
        return b"".join(record for record in records if record is not None)

    @property
    def event_log(self) -> bytes:
        """The events as JSON lines; of two runs in lockstep with one seed these are the same."""
        lines = [
            {"t_s": round(time_s, 4), "kind": kind, **fields}
            for time_s, kind, fields in self.record.events
        ]
        lines += [
            {"kind": "verdict", "name": v.name, "is_met": v.is_met, "found": v.found}
            for v in self.verdicts
        ]
        dumps = (json.dumps(plain(line), allow_nan=False, separators=(",", ":")) for line in lines)
        return "".join(f"{line}\n" for line in dumps).encode("ascii")
