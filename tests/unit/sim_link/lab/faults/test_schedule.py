"""Faults by name, when they act, and back to what a file says."""

from __future__ import annotations

import math

import msgspec
import pytest

from companion.domain import FlightMode
from sim_link.autopilot.incidents import PilotMode, VehicleReboot
from sim_link.lab.faults.fault_models import KINDS, Fault, LinkLoss, Schedule, fault_from
from tools.campaign.random_missions import fields_of

LOSS = LinkLoss(share=0.3, start_s=20.0, duration_s=5.0)


def test_a_mapping_names_a_fault_by_its_kind() -> None:
    fields: dict[str, object] = {"kind": "link_loss", "share": 0.3, "start_s": 20, "duration_s": 5}
    assert fault_from(fields) == LOSS
    switch = fault_from({"kind": "pilot_mode", "mode": "return"})
    assert switch == PilotMode(mode=FlightMode.RETURN)


@pytest.mark.parametrize(
    "fields",
    [
        {"kind": "link_los"},
        {"kind": "link_loss", "shares": 0.3},
        {"kind": "link_loss", "share": 1.3},
        {"kind": "link_loss", "duration_s": 0.0},
        {"share": 0.3},
    ],
)
def test_what_is_no_fault_is_refused(fields: dict[str, object]) -> None:
    with pytest.raises(msgspec.ValidationError):
        fault_from(fields)


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_every_kind_has_defaults_and_survives_the_way_through_a_file(kind: str) -> None:
    fault = fault_from({"kind": kind, "start_s": 3.0})
    assert fields_of(fault) == {"kind": kind, "start_s": 3.0}
    assert fault_from(fields_of(fault)) == fault


def test_a_fault_acts_from_its_start_to_its_end() -> None:
    reboot = VehicleReboot(start_s=22.0)
    schedule = Schedule(faults=(LOSS, reboot))
    assert [
        [fault.is_active(t) for fault in schedule.faults] for t in (19.9, 20.0, 24.0, 25.0)
    ] == [
        [False, False],
        [True, False],
        [True, True],
        [False, True],
    ]


def test_a_fault_without_an_end_lasts() -> None:
    fault: Fault = LinkLoss()
    assert fault.end_s == math.inf
