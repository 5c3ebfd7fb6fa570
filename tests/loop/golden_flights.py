"""Twenty-one recorded flights of many kinds, and functions that fly them again.

A golden flight is an endpoint's inputs and its configuration; `outputs.json` has digests
of every estimate and every setpoint that came of each. The flights are low and short, so that all
of them together are small and are run again in seconds. `python -m tools.update_golden` updates the
digests, or flies anew.
"""

from __future__ import annotations

import hashlib
import json
import lzma
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import msgspec
import numpy as np

from companion.config.schema import CompanionConfig, LimitsConfig, PlannerConfig
from companion.config.versions import renew
from companion.domain import FlightMode
from companion.estimation.antenna import AntennaParams
from companion.estimation.filters.target_filter import FilterConfig
from companion.estimation.tracker_params import EstimationConfig
from companion.flight_setup import FlightFacts, build_endpoint, open_flight, write_facts
from companion.guidance.commands import SessionParams
from companion.guidance.emitters import QueueParams
from companion.guidance.events import OperatorCommand, OperatorCommandReceived
from companion.io.files import INPUTS
from companion.io.flight_recorder import FlightJournal
from companion.io.log_files import parse_inputs
from companion.link.endpoint import CompanionEndpoint
from companion.link.interface import Journal, LinkSpec, VehicleParams
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from companion.mav.endpoint import Chunk
from companion.planning.crossing import LatchedCrossingParams
from companion.replay.recorded_flight import Outputs, rerun
from sim_link.autopilot.incidents import Incident, PilotMode
from sim_link.autopilot.scenario import AutopilotParams, Scenario
from sim_link.lab.faults.fault_models import Fault, LinkDelay, LinkJitter, LinkLoss, Schedule
from sim_link.lab.faults.faulty_link import FaultyLink
from sim_link.lab.lockstep import VEHICLE_PEER, Flight, Makers, MemoryJournal, Operator
from sim_link.world.environment import EmitterParams
from tools.campaign.checkpointing import Checkpointing

FOLDER = Path(__file__).parents[1] / "data" / "golden"
SUFFIX = ".flight.xz"
OUTPUTS = FOLDER / "outputs.json"
ALTITUDE_M = 6.5
DURATION_S = 24.0
SAMPLE_EVERY = 10
MISSION = SessionParams(engage="auto", altitude_m=ALTITUDE_M)
NEAR = EmitterParams(position_enu_m=(35.0, 30.0))
CONFIGURED = EstimationConfig(filter=FilterConfig(antenna=AntennaParams(kind="azimuth")))
AUTO = CompanionConfig(mission=MISSION, estimation=CONFIGURED)
CANONICAL = Scenario(emitter=NEAR)
SECOND = EmitterParams(emitter_id=2, position_enu_m=(15.0, 40.0))
KEEP_OUT = (((18.0, 15.0), (26.0, 15.0), (26.0, 26.0), (18.0, 26.0)),)

Happening = tuple[float, Callable[[Flight], None]]


@dataclass(frozen=True, slots=True)
class Plan:
    """Configuration and scenario of a golden flight."""

    config: CompanionConfig = AUTO
    scenario: Scenario = CANONICAL
    faults: tuple[Fault, ...] = ()
    happenings: tuple[Happening, ...] = ()
    is_killed: bool = False
    """True if the recorded process resumes from the checkpoint of the one before."""


class Golden(msgspec.Struct, frozen=True):
    """A golden flight on disk: the recorded inputs of each endpoint."""

    facts: FlightFacts
    inputs: bytes


class GoldenOutput(msgspec.Struct, frozen=True):
    """Result of a golden flight."""

    estimates: int
    setpoints: int
    estimates_digest: str
    setpoints_digest: str
    samples: tuple[tuple[float, float, float, float], ...]
    """Time, east, north and R95 of every tenth estimate."""
    arithmetic: str = ""
    """Arithmetic of the machine that it was recorded on."""

    @property
    def is_of_this_arithmetic(self) -> bool:
        """True if this machine's arithmetic must give the same last digits."""
        return self.arithmetic == arithmetic()

    @classmethod
    def of(cls, output: Outputs) -> GoldenOutput:
        """Return the part of a output that is stored."""
        return cls(
            estimates=len(output.estimates),
            setpoints=len(output.setpoints),
            estimates_digest=estimates_digest(output),
            setpoints_digest=setpoints_digest(output),
            samples=samples_of(output),
            arithmetic=arithmetic(),
        )


@cache
def arithmetic() -> str:
    """Return how this machine rounds, tried on functions that estimators use.

    The last digits of linear algebra and of elementary functions depend on the processor's vector
    units, for which numpy and its BLAS have code of their own, and on the C library.
    """
    rng = np.random.default_rng(1)
    tried: list[object] = [math.exp(0.1), math.log(0.3), math.sin(1.1), math.atan2(0.3, -0.7)]
    for size in (2, 3, 4, 5, 6, 12, 60):
        a, b = rng.normal(size=(size, size)), rng.normal(size=(size, 3))
        spd = a @ a.T + np.eye(size)
        tried += [a @ b, a.T @ a, np.linalg.solve(spd, b), np.linalg.inv(spd), a @ b[:, 0]]
        tried += [np.linalg.eigh(spd)[0], np.linalg.cholesky(spd), np.linalg.det(spd), a.mean(1)]
    x = rng.uniform(0.01, 9.0, 97)
    tried += [np.exp(-x), np.log(x), np.sin(x), np.cos(x), np.arctan2(x - 4.0, x), np.sqrt(x)]
    tried += [np.hypot(x, 1.0 - x), np.tanh(x), x.sum(), x.std(), np.linalg.norm(x), x**1.7]
    digest = hashlib.sha256(b"".join(np.asarray(each).tobytes() for each in tried))
    build = np.show_config(mode="dicts")
    assert build is not None
    digest.update(json.dumps((np.__version__, build["SIMD Extensions"]), sort_keys=True).encode())
    return digest.hexdigest()[:16]


def samples_of(output: Outputs) -> tuple[tuple[float, float, float, float], ...]:
    rows = []
    for line in output.estimates[::SAMPLE_EVERY]:
        position = line["position_enu_m"]
        assert isinstance(position, list | tuple)
        rows.append((float(str(line["t_s"])), *map(float, position), float(str(line["r95_m"]))))
    return tuple((t, e, n, r) for t, e, n, r in rows)


def estimates_digest(output: Outputs) -> str:
    text = "\n".join(json.dumps(line, sort_keys=True) for line in output.estimates)
    return hashlib.sha256(text.encode()).hexdigest()


def setpoints_digest(output: Outputs) -> str:
    return hashlib.sha256(b"".join(output.setpoints)).hexdigest()


def replayed(golden: Golden) -> Outputs:
    """The output of a golden flight, run again."""
    inputs = parse_inputs(golden.inputs, "golden")
    return rerun(inputs, golden.facts.config, golden.facts)


def load(path: Path) -> Golden:
    raw = msgspec.msgpack.decode(lzma.decompress(path.read_bytes()))
    # most were recorded when an antenna could not be configured, and was taken for an azimuth's
    believed = raw["facts"]["config"]["estimation"]["filter"]
    believed.setdefault("antenna", {"kind": "azimuth"})
    # and when the first autopilot heard was bound at once, as one of a configured system still is
    raw["facts"]["config"]["vehicle"]["system_id"] = 1
    renew(raw["facts"]["config"], str(path))
    return msgspec.convert(raw, Golden)


def load_outputs() -> dict[str, GoldenOutput]:
    return msgspec.json.decode(OUTPUTS.read_bytes(), type=dict[str, GoldenOutput])


def save_outputs(outputs: Mapping[str, GoldenOutput]) -> None:
    OUTPUTS.write_bytes(msgspec.json.format(msgspec.json.encode(outputs), indent=1) + b"\n")


def save(golden: Golden, path: Path) -> None:
    path.write_bytes(lzma.compress(msgspec.msgpack.encode(golden), preset=9))


def fly(plan: Plan, directory: Path) -> Golden:
    """Fly a golden flight and keep the log of its last process.

    Args:
        plan: Plan of the flight.
        directory: Folder for the logs of its processes.
    """
    journals: list[FlightJournal] = []

    def companion(
        config: CompanionConfig, journal: Journal, links: Sequence[LinkSpec]
    ) -> CompanionEndpoint:
        del journal
        folder = directory / str(len(journals))
        folder.mkdir()
        write_facts(folder, FlightFacts(started_unix_s=1.8e9, links=len(links), config=config))
        journals.append(FlightJournal(folder, 1.8e9))
        return build_endpoint(config, journals[-1], links, recorder=journals[-1].inputs)

    wire = FaultyLink(Schedule(faults=plan.faults), 1)
    flight = Flight(
        plan.config, plan.scenario, 1, MemoryJournal(), wire=wire, makers=Makers(companion)
    )
    if plan.is_killed:
        Checkpointing(flight)
    for time_s, action in plan.happenings:
        flight.at(time_s, partial(action, flight))
    flight.run(DURATION_S)
    for journal in journals:
        journal.close(timeout_s=30.0)
    folder = directory / str(len(journals) - 1)
    return Golden(facts=open_flight(folder).facts, inputs=(folder / INPUTS).read_bytes())


def ask(command: OperatorCommand, flight: Flight) -> None:
    flight.companion.handle_event(OperatorCommandReceived(flight.now_s, command))


def set_parameter(name: bytes, value: float, flight: Flight) -> None:
    change = mavlink.MAVLink_param_set_message(1, 191, name, value, 9)
    frame = MavCodec(255, 190).encode(change)
    flight.companion.receive(Chunk(0, frame, VEHICLE_PEER), flight.now_s)


def cut_ranging(is_up: bool, flight: Flight) -> None:
    flight.is_ranging_up = is_up


def happen(incident: Incident, flight: Flight) -> None:
    flight.apply_incident(incident)


def choose(mode: FlightMode, flight: Flight) -> None:
    Operator(flight).choose(mode)


def kill(flight: Flight) -> None:
    flight.kill_companion()


def start(flight: Flight) -> None:
    flight.start_companion()


def configured(**sections: object) -> CompanionConfig:
    return msgspec.structs.replace(AUTO, **sections)


def searching(pattern: str) -> Plan:
    planner = PlannerConfig(search=pattern)  # type: ignore[arg-type]
    payload = msgspec.structs.replace(Scenario().payload, max_range_m=30.0)
    return Plan(configured(planner=planner), Scenario(emitter=NEAR, payload=payload))


def estimated(kind: str) -> Plan:
    return Plan(configured(estimation=msgspec.structs.replace(CONFIGURED, kind=kind)))


ARDUPILOT = Scenario(emitter=NEAR, autopilot=AutopilotParams(flavour="ardupilot"))

PLANS: dict[str, Plan] = {
    "px4": Plan(),
    "ardupilot": Plan(scenario=ARDUPILOT),
    "default_estimation": Plan(configured(estimation=EstimationConfig())),
    "global_setpoints": Plan(configured(vehicle=VehicleParams(setpoint="global_int"))),
    "fim": Plan(configured(planner=PlannerConfig(kind="fim"))),
    "swing": Plan(
        CompanionConfig(
            mission=SessionParams(engage="auto", altitude_m=9.0),
            estimation=CONFIGURED,
            planner=PlannerConfig(latched_crossing=LatchedCrossingParams(altitude_swing_m=2.0)),
        )
    ),
    "lawnmower": searching("lawnmower"),
    "expanding_square": searching("expanding_square"),
    "sector": searching("sector"),
    "ekf": estimated("ekf"),
    "huber": estimated("huber"),
    "two_emitters": Plan(
        configured(emitters=QueueParams(order="nearest")),
        Scenario(emitter=NEAR, emitters=(SECOND,)),
    ),
    "keep_out": Plan(configured(limits=LimitsConfig(keep_out_enu_m=KEEP_OUT))),
    "lossy": Plan(faults=(LinkLoss(share=0.3), LinkDelay(delay_s=0.08), LinkJitter(jitter_s=0.05))),
    "ranging_cut": Plan(
        happenings=((13.0, partial(cut_ranging, False)), (20.0, partial(cut_ranging, True)))
    ),
    "wishes": Plan(
        happenings=(
            (14.0, partial(ask, OperatorCommand.HOLD)),
            (18.0, partial(ask, OperatorCommand.RESUME)),
        )
    ),
    "parameters": Plan(
        happenings=(
            (13.0, partial(set_parameter, b"CMP_SPEED", 2.0)),
            (16.0, partial(set_parameter, b"CMP_ALTITUDE", 10.0)),
            (18.0, partial(set_parameter, b"CMP_SPEED", 50.0)),
        )
    ),
    "pilot": Plan(scenario=ARDUPILOT, happenings=((17.0, partial(happen, PilotMode())),)),
    "resumed": Plan(
        is_killed=True,
        happenings=(
            (13.0, kill),
            (13.5, start),
            (15.5, partial(choose, FlightMode.HOLD)),
            (19.0, partial(choose, FlightMode.OFFBOARD)),
        ),
    ),
}
