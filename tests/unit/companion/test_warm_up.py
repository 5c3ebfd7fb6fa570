"""Invented first flights: every kernel is called, whatever will be measured."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import msgspec
import pytest

from companion import warm_up as module
from companion.estimation.antenna import AntennaKind, AntennaParams
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.measurement_model import BEARING
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.estimation.window.map_kernels import VALUES
from companion.estimation.window.window_map import WindowParams
from companion.planning.crossing import LatchedCrossing, LatchedCrossingParams
from companion.planning.planner import Plan, PlanRequest
from companion.warm_up import warm_up

SMALL = TrackerParams(window=WindowParams(size=64))


class Counting(LatchedCrossing):
    """The planner of the flight, counting what it is asked."""

    def __init__(self) -> None:
        super().__init__(LatchedCrossingParams())
        self.requests: list[PlanRequest] = []

    def plan(self, request: PlanRequest, memory: Any) -> Plan[Any]:
        self.requests.append(request)
        return super().plan(request, memory)


def test_recording_does_not_wait_for_a_window_of_the_usual_size(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    taken: list[object] = []
    fuse = TargetTracker.fuse

    def counted(self: TargetTracker, *arguments: Any) -> Any:
        taken.append(arguments)
        return fuse(self, *arguments)

    monkeypatch.setattr(TargetTracker, "fuse", counted)
    warm_up(TrackerParams(), Counting())
    assert 0 < len(taken) < TrackerParams().window.size


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["azimuth", "planar", "line", "two_axis"])
def test_ranges_and_bearings_alone_and_together_fill_the_window_and_are_planned_for(
    monkeypatch: pytest.MonkeyPatch, kind: AntennaKind
) -> None:
    antenna = FilterParams(antenna=AntennaParams(kind=kind))
    params = msgspec.structs.replace(SMALL, filter=antenna)
    kinds: Counter[tuple[bool, bool]] = Counter()
    fuse = TargetTracker.fuse

    def counted(self: TargetTracker, measurement: Any, *position_and_time: Any) -> Any:
        row = params.filter.kernel_row(measurement, (0.0, 0.0, 20.0))
        kinds[measurement.range_m is not None, not math.isnan(row[VALUES + BEARING])] += 1
        report = fuse(self, measurement, *position_and_time)
        assert report.reject_reason is None
        return report

    monkeypatch.setattr(TargetTracker, "fuse", counted)
    planner = Counting()
    warm_up(params, planner)
    assert set(kinds) == {(True, True), (True, False), (False, True)}
    assert min(kinds.values()) > module.SMALL_WINDOW
    asked_from = [request.vehicle_enu_m[0] for request in planner.requests]
    assert asked_from == 3 * [module.RADIUS_M, module.FAR_M]  # near it, and on the way to it
    assert all(request.estimate is not None for request in planner.requests)
