from __future__ import annotations

from pathlib import Path

import pytest

from companion.domain import EstimateState, TargetEstimate

pytest.importorskip("matplotlib", reason="pictures are drawn with the extra `demo`")

from companion.demo.track_plot import Obstacle, PlottedFlight, draw

FINAL = TargetEstimate(
    time_s=40.0,
    state=EstimateState.LOCALISED,
    position_enu_m=(50.0, 50.0),
    covariance_m2=((0.02, 0.0), (0.0, 0.01)),
    r95_m=0.3,
    range_offset_m=1.5,
    bearing_offset_rad=0.0,
    measurements=100,
)
BLOCK = Obstacle("block", ((30.0, 30.0), (45.0, 30.0), (45.0, 60.0)), 30.0)


def flight(*obstacles: Obstacle) -> PlottedFlight:
    return PlottedFlight(
        track_enu_m=[(10.0, 10.0), (50.0, 40.0)],
        estimates=[(1.0, 40.0, 40.0, 20.0), (40.0, 49.9, 50.0, 0.3)],
        crossings_enu_m=[(52.0, 52.0)],
        fence_enu_m=[(-10.0, -10.0), (110.0, -10.0), (110.0, 110.0), (-10.0, 110.0)],
        obstacles=obstacles,
        truth_enu_m=(50.0, 50.0),
        final=FINAL,
        title="a flight",
    )


@pytest.mark.slow
def test_obstacles_are_drawn_with_name_and_height(tmp_path: Path) -> None:
    draw(tmp_path / "plain.svg", flight())
    draw(tmp_path / "block.svg", flight(BLOCK))
    assert "<!-- block, 30 m -->" not in (tmp_path / "plain.svg").read_text(encoding="utf-8")
    assert "<!-- block, 30 m -->" in (tmp_path / "block.svg").read_text(encoding="utf-8")


def test_what_has_no_height_has_only_a_name() -> None:
    assert Obstacle("tower", BLOCK.corners_enu_m, None).label == "tower"
