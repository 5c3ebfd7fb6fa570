"""Trials of a campaign: their faults, drawn at random, and their monitored flights."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar, get_args

import msgspec
import numpy as np

from companion.config.schema import CompanionConfig
from companion.domain import FlightMode
from companion.flight_setup import build_endpoint
from companion.guidance.commands import SessionParams
from companion.link.endpoint import CompanionEndpoint
from companion.link.interface import Journal, LinkSpec
from companion.mav.signing import ONE_LINK_EACH, LinkSigning, Signing, SigningKey, timestamp_at
from sim_link.autopilot import incidents
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.incidents import ComponentName, VehicleTypeName
from sim_link.autopilot.protocols.link_layer import LinkSecurity
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from sim_link.lab.faults import fault_models as faults
from sim_link.lab.faults.fault_models import Direction, Fault, RangingField, Schedule
from sim_link.lab.faults.faulty_link import FaultyLink, Injector
from sim_link.lab.lockstep import Flight, MakeCompanion, Makers, MemoryJournal, Operator
from sim_link.lab.mission.flight_readers import rules_of
from sim_link.lab.monitor.monitor import Monitor
from tools.campaign.checkpointing import Checkpointing


@dataclass(frozen=True, slots=True)
class Trial:
    """One trial, which depends on these values only."""

    part: str
    seed: int
    size: float = 1.0
    """Amount of work, in the unit of the part; a replay uses the same."""

    @property
    def name(self) -> str:
        """Argument by which a replay is requested."""
        return f"{self.part}:{self.seed}" + ("" if self.size == 1.0 else f":{self.size:g}")


@dataclass(frozen=True, slots=True)
class TrialFinding:
    """Fault that was found, and the command that repeats it."""

    trial: str
    what: str


@dataclass(frozen=True, slots=True)
class TrialOutcome:
    """Findings and measurements of a trial, and its log for a replay.

    Over all trials counts are added, and of the other figures the extremes are kept.
    """

    trial: Trial
    findings: tuple[str, ...] = ()
    """Faults found; empty if the trial passed."""
    sums: Mapping[str, float] = field(default_factory=dict)
    most: Mapping[str, float] = field(default_factory=dict)
    least: Mapping[str, float] = field(default_factory=dict)
    story: tuple[str, ...] = ()


def frames_each(frames: int) -> Callable[[float], tuple[int, float]]:
    """Return trials of about this number of frames each, all of one size."""

    def split(amount: float) -> tuple[int, float]:
        """Return the number of trials, and the size of each."""
        count = -(-round(amount) // frames)
        return count, amount / count / frames

    return split


@dataclass(frozen=True, slots=True)
class Part:
    """One part of a campaign."""

    name: str
    title: str
    run: Callable[[Trial], TrialOutcome]
    cost_s: float = 1.0
    """Seconds of one core that a trial of size 1 takes, about; for progress and fair shares."""
    base_cost_s: float = 0.0
    """Additional time in s of every trial, regardless of its size."""
    split: Callable[[float], tuple[int, float]] = lambda amount: (round(amount), 1.0)
    """Return the number of trials for an amount of the part, and the size of each trial."""

    def trials(self, amount: float, seed: int) -> list[Trial]:
        """Return the trials of a part, each with its own seed."""
        count, size = self.split(amount)
        return [Trial(self.name, seed * 1_000_000 + index, size) for index in range(count)]

    def cost(self, trial: Trial) -> float:
        """Return the approximate seconds of one core."""
        return self.base_cost_s + self.cost_s * trial.size


KEY = SigningKey(bytes(range(100, 132)))
STARTED_UNIX_S = 1.795e9
STATION_LINK = 200


class SignedPair:
    """Makes the two ends of a signed link, as often as needed."""

    def __init__(self) -> None:
        started = timestamp_at(STARTED_UNIX_S)
        self._companion = Signing(KEY, started, rules=ONE_LINK_EACH)
        self._vehicle = Signing(KEY, started)
        self.station = LinkSigning(Signing(KEY, started), STATION_LINK)

    def companion(
        self, config: CompanionConfig, journal: Journal, links: Sequence[LinkSpec]
    ) -> CompanionEndpoint:
        """Return a companion that resumes from the previous one's final checkpoint."""
        before = self._companion
        self._companion = Signing(KEY, before.timestamp, dict(before.streams), ONE_LINK_EACH)
        return build_endpoint(
            config, journal, links, signing=self._companion, started_unix_s=STARTED_UNIX_S
        )

    def simulator(self, scenario: Scenario, seed: int, now_s: float) -> SimEndpoint:
        """Return a vehicle that continues from its newest timestamp."""
        self._vehicle = Signing(KEY, self._vehicle.timestamp)
        security = LinkSecurity(self._vehicle, started_unix_s=STARTED_UNIX_S + now_s)
        return SimEndpoint(scenario, seed, now_s, security=security)


def snapshot_of(flight: Flight) -> tuple[str, object]:
    """Return the companion's phase, and the other state it acts by, for comparison."""
    companion = flight.companion
    session, vehicle = companion.session, companion.session.vehicle
    acted_on = (
        session.estimate,
        vehicle.heartbeat,
        vehicle.position_enu_m,
        vehicle.home_enu_m,
        vehicle.origin,
        vehicle.landed,
        companion.binding.system_id,
        companion.binding.peer,
        companion.binding.heard_s,
    )
    return session.phase.value, acted_on


ENDLESS = CompanionConfig(mission=SessionParams(engage="auto", stop_confirm_s=1e6))
"""Configuration of a companion that launches by itself and never stops searching."""


def flavour_of(seed: int) -> FlavourName:
    """Return PX4 or ArduPilot, alternately by trial."""
    return "px4" if seed % 2 else "ardupilot"


@dataclass(slots=True)
class Monitored:
    """A flight with all its observers."""

    flight: Flight
    operator: Operator
    injector: Injector
    monitor: Monitor
    notes: MemoryJournal
    checkpointing: Checkpointing

    @property
    def findings(self) -> list[str]:
        """The violations so far."""
        return [str(violation) for violation in self.monitor.violations]

    @property
    def story(self) -> tuple[str, ...]:
        """Texts that the companion sent to the operator."""
        return story_lines(self.notes.texts)


def story_lines(texts: Iterable[tuple[float, str]]) -> tuple[str, ...]:
    """Return texts to the operator with their times, for a replay."""
    return tuple(f"{time_s:8.2f} s  {text}" for time_s, text in texts)


def monitored_flight(
    config: CompanionConfig,
    scenario: Scenario,
    seed: int,
    *,
    is_signed: bool = False,
    is_spoofing: bool | None = None,
    make_companion: MakeCompanion | None = None,
) -> Monitored:
    """Return a flight that has not begun.

    Attackers are spoofing by default where the link is signed.
    """
    pair = SignedPair() if is_signed else None
    key = KEY if is_signed else None
    notes, link = MemoryJournal(), FaultyLink(Schedule(), seed, key=key)
    genuine = build_endpoint if pair is None else pair.companion
    makers = Makers(make_companion or genuine, SimEndpoint if pair is None else pair.simulator)
    flight = Flight(config, scenario, seed, notes, wire=link, makers=makers)
    operator = Operator(flight, pair.station if pair else None, STARTED_UNIX_S)
    monitor = Monitor(
        rules_of(config),
        flight.sim.vehicle,
        estimate=lambda: flight.companion.session.estimate,
        snapshot=lambda: snapshot_of(flight),
        key=key,
        dropped=lambda: flight.companion.dropped_unread,
    )
    flight.observers.append(monitor)
    is_near = is_signed if is_spoofing is None else is_spoofing
    injector = Injector(flight, link, operator, is_spoofing=is_near)
    return Monitored(flight, operator, injector, monitor, notes, Checkpointing(flight))


def launched_flight(seed: int, salt: int) -> tuple[Monitored, Dice]:
    """Return a flight that the companion launches, with either autopilot, and its generator."""
    dice = Dice(np.random.default_rng((seed, salt)))
    scenario = Scenario(autopilot=AutopilotParams(flavour=dice.flavour()))
    return monitored_flight(ENDLESS, scenario, seed), dice


T = TypeVar("T")
MODES = (FlightMode.HOLD, FlightMode.RETURN, FlightMode.LAND)
UNIT_FACTORS = (0.001, 0.01, 180.0 / math.pi, 100.0, 1000.0)
MUTED = ("LOCAL_POSITION_NED", "HEARTBEAT", "ATTITUDE", "HOME_POSITION", "EXTENDED_SYS_STATE")
DIRECTIONS: tuple[Direction, ...] = ("both", "to_companion", "to_vehicle")
FIELDS: tuple[RangingField, ...] = ("both", "range", "bearing")
FENCE_PARAMETERS = ("FENCE_RADIUS", "FENCE_ALT_MAX", "GF_MAX_HOR_DIST", "GF_MAX_VER_DIST")
"""Fence parameters of both autopilots; one that the other autopilot has changes nothing."""
COMPONENTS = get_args(ComponentName)
TYPES = get_args(VehicleTypeName)
JUMP_M = 7.0
EARLIEST_S, LATEST_S = 2.0, 30.0
SHORTEST_S, LONGEST_S = 0.3, 15.0


class Dice:
    """Random draws for trials."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def number(self, low: float, high: float) -> float:
        """Return a uniform random number."""
        return round(float(self._rng.uniform(low, high)), 3)

    def spread(self, low: float, high: float) -> float:
        """Return a log-uniform random number."""
        return round(math.exp(float(self._rng.uniform(math.log(low), math.log(high)))), 3)

    def one(self, choices: Sequence[T]) -> T:
        """Return a random choice."""
        return choices[int(self._rng.integers(len(choices)))]

    def happens(self, share: float) -> bool:
        """Return True with a probability."""
        return float(self._rng.random()) < share

    def flavour(self) -> FlavourName:
        """Return a random autopilot."""
        return "px4" if self.happens(0.5) else "ardupilot"


def _jump(dice: Dice) -> Fault:
    heading = dice.number(-math.pi, math.pi)
    size_m = dice.one((1.0, JUMP_M))
    return incidents.EkfJump(
        east_m=round(size_m * math.cos(heading), 3),
        north_m=round(size_m * math.sin(heading), 3),
        yaw_deg=dice.one((0.0, 0.0, 30.0)),
    )


def _wind(dice: Dice) -> Fault:
    heading = dice.number(-math.pi, math.pi)
    return incidents.WindChange(
        east_mps=round(12.0 * math.cos(heading), 3), north_mps=round(12.0 * math.sin(heading), 3)
    )


DRAWS: tuple[Callable[[Dice], Fault], ...] = (
    lambda d: faults.LinkLoss(share=d.number(0.05, 0.6), direction=d.one(DIRECTIONS)),
    lambda d: faults.LinkBursts(
        mean_good_s=d.number(0.3, 3.0), mean_bad_s=d.number(0.05, 1.0), direction=d.one(DIRECTIONS)
    ),
    lambda d: faults.LinkBlackout(direction=d.one(DIRECTIONS)),
    lambda d: faults.LinkDelay(delay_s=d.number(0.02, 0.25), direction=d.one(DIRECTIONS)),
    lambda d: faults.LinkJitter(jitter_s=d.number(0.05, 0.3), direction=d.one(DIRECTIONS)),
    lambda d: faults.LinkDuplicates(share=d.number(0.05, 0.5), copies=d.one((1, 2, 5))),
    lambda d: faults.LinkBitFlips(share=d.number(0.01, 0.3), bits=d.one((1, 2, 8))),
    lambda d: faults.LinkTruncation(share=d.number(0.01, 0.3)),
    lambda d: faults.LinkGarbage(share=d.number(0.05, 0.5)),
    lambda d: faults.LinkRateCap(bits_per_s=d.one((9600.0, 57_600.0, 115_200.0))),
    lambda d: faults.LinkHold(direction=d.one(DIRECTIONS)),
    lambda d: faults.StreamMute(message=d.one(MUTED)),
    lambda d: faults.TelemetryNonsense(share=d.number(0.05, 0.5)),
    lambda d: faults.RangingDropout(missing=d.one(FIELDS)),
    lambda _: faults.RangingFreeze(),
    lambda d: faults.RangingWrongUnit(of=d.one(FIELDS), factor=d.one(UNIT_FACTORS)),
    lambda d: faults.RangingOutliers(share=d.number(0.05, 0.4), excess_m=d.number(10.0, 80.0)),
    lambda d: faults.RangingStale(age_s=d.number(0.3, 3.0)),
    lambda d: faults.RangingOutOfOrder(window_s=d.number(0.2, 1.0)),
    lambda d: faults.RangingSecondEmitter(
        east_m=d.number(-20.0, 110.0),
        north_m=d.number(-20.0, 110.0),
        emitter_id=d.one((None, 0, 9)),
    ),
    lambda d: faults.RangingNan(share=d.number(0.1, 1.0)),
    lambda d: incidents.VehicleReboot(down_s=d.number(0.2, 3.0)),
    lambda d: incidents.ClockRate(rate=d.number(0.95, 1.05)),
    lambda d: incidents.ClockSlip(step_s=d.one((-2.0, -0.7, 1.0, 5.0))),
    lambda d: incidents.AutopilotStall(duration_s=d.number(0.2, 3.0)),
    _jump,
    lambda d: incidents.EkfPoor(ratio=d.number(1.1, 3.0)),
    lambda _: incidents.GpsLoss(),
    _wind,
    lambda d: incidents.BatteryCharge(share=d.one((None, 0.14, 0.1, 0.06, 0.02))),
    lambda d: incidents.OriginShift(east_m=d.number(-12.0, 12.0), north_m=d.number(-12.0, 12.0)),
    lambda d: incidents.PilotMode(mode=d.one(MODES)),
    lambda d: incidents.PilotSticks(forward=d.number(-1.0, 1.0), right=d.number(-1.0, 1.0)),
    lambda d: faults.ModeFlap(mode=d.one(MODES), period_s=d.number(0.3, 3.0)),
    lambda d: incidents.Failsafe(mode=d.one((FlightMode.RETURN, FlightMode.LAND))),
    lambda _: faults.Disarm(),
    lambda d: faults.SecondSender(
        rate_hz=d.number(2.0, 30.0), east_m=d.number(0.0, 40.0), north_m=d.number(0.0, 40.0)
    ),
    lambda d: faults.CompanionKilled(down_s=d.spread(0.2, 10.0)),
    lambda _: faults.CompanionStalled(),
    lambda _: faults.CompanionTerminated(),
    lambda d: faults.ForgedFrames(rate_hz=d.spread(10.0, 500.0)),
    lambda d: faults.ReplayedFrames(rate_hz=d.spread(10.0, 500.0)),
    lambda d: faults.UnsignedFrames(rate_hz=d.spread(10.0, 500.0)),
    lambda d: faults.ForeignFrames(rate_hz=d.spread(10.0, 500.0)),
    lambda _: incidents.FalseLanding(),
    lambda d: incidents.StationFence(
        half_side_m=d.one((None, d.number(15.0, 80.0), d.number(15.0, 80.0))),
        east_m=d.number(-10.0, 30.0),
        north_m=d.number(-10.0, 30.0),
        is_circle=d.happens(0.3),
        is_inclusion=d.happens(0.9),
        shares_line=d.happens(0.5),
    ),
    lambda d: incidents.StationHome(
        east_m=d.number(-25.0, 25.0), north_m=d.number(-25.0, 25.0), shares_line=d.happens(0.5)
    ),
    lambda d: incidents.StationParameter(
        name=d.one(FENCE_PARAMETERS), value=d.number(60.0, 300.0), shares_line=d.happens(0.5)
    ),
    lambda d: incidents.StationRates(
        message=d.one(MUTED), rate_hz=d.one((0.0, 0.2, 1.0)), shares_line=d.happens(0.5)
    ),
    lambda d: incidents.OtherComponent(component=d.one(COMPONENTS)),
    lambda d: incidents.OtherVehicle(
        system_id=d.one((1, 1, 2)),
        has_own_address=d.happens(0.5),
        vehicle_type=d.one(TYPES),
        flavour=d.one(("same", "px4", "ardupilot")),
        uptime_s=d.spread(1.0, 5000.0),
        east_m=d.number(-80.0, 80.0),
        north_m=d.number(-80.0, 80.0),
        is_offboard=d.happens(0.7),
    ),
)
"""Every kind of fault in the order of `Fault`, but for the transmitter, which has no pilot."""


def random_fault(rng: np.random.Generator) -> Fault:
    """Return a random fault at a random time of a flight."""
    dice = Dice(rng)
    fault = dice.one(DRAWS)(dice)
    times = {
        "start_s": dice.number(EARLIEST_S, LATEST_S),
        "duration_s": dice.spread(SHORTEST_S, LONGEST_S),
    }
    return msgspec.structs.replace(fault, **times)
