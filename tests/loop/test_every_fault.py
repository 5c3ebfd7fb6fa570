"""One short flight per kind of fault, on both autopilots in turn: no invariant breaks."""

from __future__ import annotations

import hashlib
from functools import lru_cache

import msgspec
import pytest

from companion.config.schema import CompanionConfig
from companion.guidance.commands import SessionParams
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, RcParams, Scenario
from sim_link.lab.faults.fault_models import KINDS, Fault, Schedule, fault_from
from sim_link.lab.faults.faulty_link import Injector
from sim_link.lab.observer import Frame, Observer
from tools.campaign.flights import Monitored, Trial, monitored_flight
from tools.campaign.runner import run_one

pytestmark = pytest.mark.slow

AUTO = CompanionConfig(mission=SessionParams(engage="auto", stop_confirm_s=1e6))
ENGAGED_S, FAULT_S, AFTER_S = 13.0, 3.0, 4.0
WITH_TRANSMITTER = ("pilot_sticks", "rc_loss")
SIGNED = ("forged_frames", "replayed_frames", "unsigned_frames")
OF_ARDUPILOT = ("station_parameter",)
"""FENCE_RADIUS, which it sets, is a parameter of ArduPilot only."""
NAMES = sorted(KINDS)
MISSIONS = (1, 5, 9, 14)


class Mark(Observer):
    """A digest of all that was heard and sent, and when: what a fault must change."""

    def __init__(self) -> None:
        self._hash = hashlib.blake2b(digest_size=16)

    def heard(self, frame: Frame) -> None:
        self._take("heard", frame)

    def vehicle_heard(self, frame: Frame) -> None:
        self._take("vehicle heard", frame)

    def _take(self, who: str, frame: Frame) -> None:
        self._hash.update(f"{who} {frame.time_s:.6f} {frame.is_intact}".encode() + frame.data)

    @property
    def digest(self) -> str:
        return self._hash.hexdigest()


def flavour_of(kind: str) -> FlavourName:
    """Return the autopilot on which `kind` is tried: they take turns."""
    return "px4" if NAMES.index(kind) % 2 and kind not in OF_ARDUPILOT else "ardupilot"


def flown(kind: str, *faults: Fault) -> tuple[Monitored, str]:
    """The search in which `kind` is tried: autopilot, pilot and signing are chosen by it."""
    return _flown(flavour_of(kind), kind in WITH_TRANSMITTER, kind in SIGNED, faults)


def _flown(
    flavour: FlavourName, has_rc: bool, is_signed: bool, faults: tuple[Fault, ...]
) -> tuple[Monitored, str]:
    scenario = Scenario(autopilot=AutopilotParams(flavour=flavour), rc=RcParams(is_present=has_rc))
    around, mark = monitored_flight(AUTO, scenario, 3, is_signed=is_signed), Mark()
    around.flight.observers.append(mark)
    around.flight.run(ENGAGED_S)
    around.injector.inject(Schedule(faults=faults))
    around.flight.run(1.0 + FAULT_S + AFTER_S)
    return around, mark.digest


@lru_cache
def peace(flavour: FlavourName, has_rc: bool, is_signed: bool) -> str:
    """The digest of the same search when nothing goes wrong."""
    return _flown(flavour, has_rc, is_signed, ())[1]


def peace_of(kind: str) -> str:
    return peace(flavour_of(kind), kind in WITH_TRANSMITTER, kind in SIGNED)


def fault_of(kind: str) -> Fault:
    fault = fault_from({"kind": kind, "start_s": 1.0})
    changed: Fault = msgspec.structs.replace(fault, duration_s=FAULT_S)
    return changed


@pytest.mark.parametrize("kind", NAMES)
def test_no_invariant_breaks_while_this_goes_wrong(kind: str) -> None:
    around, mark = flown(kind, fault_of(kind))
    assert [str(violation) for violation in around.monitor.violations] == []
    assert around.monitor.fence.closest_m > 0.0
    assert mark != peace_of(kind)  # it did go wrong


@pytest.mark.parametrize("kind", ["companion_stalled", "forged_frames", "link_loss", "wind"])
def test_an_injector_that_does_nothing_would_be_noticed(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Injector, "add", lambda *_: None)
    assert flown(kind, fault_of(kind))[1] == peace_of(kind)


@pytest.mark.parametrize("seed", MISSIONS)
def test_random_missions_with_several_faults_break_none(seed: int) -> None:
    assert run_one(Trial("missions", seed)).findings == ()
