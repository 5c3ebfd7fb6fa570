"""Estimators of other projects: they find a simulated target, and their scores add up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from companion.replay.walk_replay import WalkRow
from tools.compare_estimators import main, ratio_text, score_of, shifted
from tools.study.walks.rival_estimators import RIVALS, Batch
from tools.study.walks.walk_figures import preset_of, targets_of

TARGET = (12.0, 9.0)
HEADER = "t_s,agent_x_m,agent_y_m,agent_z_m,target_id,range_m,bearing_rad,target_x_m,target_y_m\n"


def walk(path: Path, late_share: float = 0.0) -> Path:
    """Write a walk around a corner with ranges of 0.15 m noise, some of them 5 m too long."""
    rng = np.random.default_rng(7)
    lines = [HEADER]
    for step in range(80):
        east_m, north_m = (0.3 * step, 0.0) if step < 40 else (12.0, 0.3 * (step - 40) - 6.0)
        range_m = math.dist((east_m, north_m), TARGET) + 0.15 * rng.standard_normal()
        range_m += 5.0 * (rng.random() < late_share)
        line = f"{step},{east_m},{north_m},0,A,{range_m:.4f},,{TARGET[0]},{TARGET[1]}"
        lines.append(line + "\n")
    path.write_text("".join(lines), encoding="utf-8")
    return path


@pytest.mark.parametrize("name", RIVALS)
def test_every_estimator_finds_a_target_among_good_ranges(name: str, tmp_path: Path) -> None:
    path = walk(tmp_path / "uwb_clean.csv")
    (rows,) = targets_of(path, 0.05)
    samples = RIVALS[name](Batch.of(rows, preset_of(path).filter), np.random.default_rng(1))
    error_m, r95_m, _, energy_m = score_of(samples, TARGET, None, None)
    assert error_m < 0.4
    assert 0.0 < r95_m < 1.0
    assert 0.0 < energy_m < 0.4


def test_the_asymmetric_loss_forgives_ranges_that_are_too_long(tmp_path: Path) -> None:
    path = walk(tmp_path / "uwb_nlos.csv", late_share=0.3)
    (rows,) = targets_of(path, 0.05)
    batch = Batch.of(rows, preset_of(path).filter)
    errors = {
        name: score_of(RIVALS[name](batch, np.random.default_rng(1)), TARGET, None, None)[0]
        for name in ("least squares", "GTSAM, asymmetric Cauchy")
    }
    assert errors["GTSAM, asymmetric Cauchy"] < 0.5 * errors["least squares"]


def test_a_score_counts_radii_about_the_stated_position() -> None:
    samples = np.random.default_rng(3).standard_normal((4000, 2))
    error_m, r95_m, inside, energy_m = score_of(samples, (3.0, 0.0), 4.0, (0.0, 0.0))
    assert (error_m, r95_m) == (3.0, 4.0)
    assert inside == (False, False, True, True)
    right = score_of(samples, (0.0, 0.0), None, None)[3]
    assert right < energy_m


def test_the_command_prints_a_row_for_each_estimator(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    walk(tmp_path / "uwb_clean.csv")
    picture, figures = tmp_path / "a.png", tmp_path / "a.json"
    arguments = [str(tmp_path), "--own-sigma", "0.05"]
    assert main([*arguments, "--plot", str(picture), "--json", str(figures)]) == 0
    printed = capsys.readouterr().out
    assert all(f"| {name} |" in printed for name in ("tracker", *RIVALS))
    assert picture.stat().st_size > 1000
    assert figures.read_text(encoding="utf-8").count('"energy_m"') == 1 + len(RIVALS)


def test_a_ratio_of_few_targets_has_a_wide_interval() -> None:
    errors = np.abs(np.random.default_rng(2).normal(size=200)).tolist()
    radii = [1.96] * 200
    assert ratio_text([0.5] * 9, [1.0] * 9) == "2.00 (2.0 to 2.0)"
    many, few = ratio_text(errors, radii), ratio_text(errors[:6], radii[:6])
    low, high = (float(word.strip("()")) for word in many.split()[1::2])
    assert low < 1.0 < high < 1.3
    assert float(few.split()[-1].strip(")")) > 1.5 * high


def test_errors_are_shifted_along_the_path_in_their_order(tmp_path: Path) -> None:
    (rows,) = targets_of(walk(tmp_path / "uwb_clean.csv"), 0.05)

    def errors_m(of: Sequence[WalkRow]) -> list[float]:
        return [(r.measurement.range_m or 0.0) - math.dist(r.agent_enu_m[:2], TARGET) for r in of]

    recorded = np.array(errors_m(rows))
    walks = shifted(rows, 3, np.random.default_rng(5))
    assert len(walks) == 3
    for each in walks:
        assert [r.agent_enu_m for r in each] == [r.agent_enu_m for r in rows]
        found = np.array(errors_m(each))
        by = min(range(80), key=lambda k: np.abs(found - np.roll(recorded, k)).max())
        assert by > 0
        # the line of scale and offset is not shifted with the noise of 0.15 m about it
        assert found == pytest.approx(np.roll(recorded, by), abs=0.15)


def test_a_folder_without_walks_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main([str(tmp_path)])
    assert "no recorded walk" in capsys.readouterr().err
