"""A watch that calls itself idle is not asked: it would find nothing, and change nothing."""

from __future__ import annotations

import random
from collections import Counter

from companion.domain import BatteryLevel, LandedState, VehicleState
from companion.guidance.control_authority import Watch
from companion.guidance.events import (
    AutopilotRestarted,
    BatteryReported,
    EstimatorStatusReported,
    Event,
    FixReported,
    HeartbeatReceived,
    LandedStateChanged,
    OperatorCommand,
    OperatorCommandReceived,
    RcStatusReported,
    SticksReported,
    ThrottleReported,
    VehicleMoved,
)
from tests.unit.companion.guidance.scripted import ScriptedFlight


def any_event(rng: random.Random, flight: ScriptedFlight) -> Event:
    """Good or bad news about anything that a watch watches."""
    now_s, is_bad = flight.now_s, rng.random() < 0.5
    jumped = (flight.position_enu_m[0] + 30.0 * is_bad, *flight.position_enu_m[1:])
    heartbeat = (flight.autopilot, flight.mode, flight.is_armed, flight.is_ready)
    news: tuple[Event, ...] = (
        BatteryReported(now_s, 3.0 if is_bad else 90.0, BatteryLevel.UNKNOWN),
        EstimatorStatusReported(now_s, 2.0 if is_bad else 0.1, has_position=not is_bad),
        FixReported(now_s, has_fix=not is_bad),
        HeartbeatReceived(now_s, *heartbeat, is_failsafe=is_bad),
        LandedStateChanged(now_s, LandedState.ON_GROUND if is_bad else LandedState.IN_AIR),
        ThrottleReported(now_s, 0.5 if is_bad else 0.05),
        SticksReported(now_s, (0.0, 0.9 * is_bad, 0.0, 0.0)),
        RcStatusReported(now_s, is_healthy=not is_bad),
        VehicleMoved(now_s, VehicleState(now_s + 0.02, jumped, (0.0, 0.0, 0.0))),
        OperatorCommandReceived(now_s, rng.choice(list(OperatorCommand))),
        *((AutopilotRestarted(now_s),) if rng.random() < 0.1 else ()),
    )
    return rng.choice(news)


def shown(watch: Watch) -> dict[str, str]:
    """Return all fields of a watch as text."""
    return {name: repr(value) for name, value in vars(watch).items()}


def test_an_idle_watch_would_find_nothing_and_change_nothing() -> None:
    rng, idle, busy = random.Random(1), Counter[str](), Counter[str]()
    for _ in range(40):
        flight = ScriptedFlight().in_control()
        for _ in range(6):
            event = any_event(rng, flight)
            for _ in range(2):  # some count from the second on
                flight.give(event)
            flight.fly(rng.choice((0.05, 0.3, 1.5)))
            for watch in flight.session._watches._all:
                if not watch.is_idle:
                    busy[type(watch).__name__] += 1
                    continue
                idle[type(watch).__name__] += 1
                before = shown(watch)
                assert watch.step(flight.now_s) is None
                assert shown(watch) == before
    both = {"BatteryWatch", "HealthWatch", "JumpWatch", "LandingWatch", "OperatorCommandWatch"}
    assert idle.keys() & busy.keys() >= both | {"PassingHold", "StickWatch"}
