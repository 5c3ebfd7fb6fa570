"""Presets chosen from recorded walks: the file that is judged has no say in the choice."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.domain import EstimateState
from tools.study.walks.walk_choice import (
    TRIED,
    Job,
    choices,
    jobs_in,
    rank,
    score,
    variants_of,
    varied,
)
from tools.study.walks.walk_figures import Claim, TargetClaims, preset_of

A, B = Path("wsr_a.csv"), Path("wsr_b.csv")
VARIANTS = list(variants_of("wifi_aoa"))


def targets(error_m: float | None) -> list[TargetClaims]:
    final = None if error_m is None else Claim(EstimateState.SEARCHING, error_m, error_m, 1.0)
    return [TargetClaims("walk", "1", 10, final=final, seconds=0.01)]


def test_a_file_is_judged_with_what_the_other_one_chooses() -> None:
    good_on_a, good_on_b = VARIANTS[3], VARIANTS[8]
    results = {Job(path, variant): targets(5.0) for path in (A, B) for variant in VARIANTS}
    results |= {Job(A, good_on_a): targets(0.1), Job(A, good_on_b): targets(2.0)}
    results |= {Job(B, good_on_b): targets(0.2), Job(B, good_on_a): targets(3.0)}
    lines = choices(results)
    for line, chosen in zip(lines, (good_on_b, good_on_a), strict=False):
        for key, value in zip(TRIED["wifi_aoa"], chosen, strict=True):
            assert f"{key} {value:g}" in line
    assert lines[3].split()[-3:] == ["90", "%", "2.90"]  # of 2.0 and 3.0, not of 0.1 and 0.2


def test_claims_that_hold_come_before_small_errors() -> None:
    def claimed(error_m: float, held: int) -> list[TargetClaims]:
        made = [Claim(EstimateState.LOCALISED, 0.5, 0.5, 1.0)] * held
        made += [Claim(EstimateState.LOCALISED, 2.0, 2.0, 1.0)] * (50 - held)
        return [TargetClaims("walk", "1", 10, along=made, final=targets(error_m)[0].final)]

    assert rank(claimed(0.5, 47)) < rank(claimed(0.4, 46)) < rank(claimed(0.4, 45))
    assert rank(claimed(0.4, 48)) < rank(claimed(0.5, 50))


def test_a_target_that_is_never_found_is_the_worst_of_all() -> None:
    assert score(targets(None)) > score(targets(1e6))


@pytest.mark.parametrize("preset", TRIED)
def test_every_key_that_is_tried_is_one_of_the_preset(preset: str) -> None:
    path = Path({"wifi_rtt": "rtt.csv", "wifi_aoa": "wsr.csv"}[preset])
    params = preset_of(path)
    seen = {varied(params, preset, variant).filter for variant in variants_of(preset)}
    assert len(seen) == len(list(variants_of(preset)))
    assert params.filter in seen  # what ships was tried, too


def test_a_walk_without_another_of_its_kind_cannot_be_left_out(tmp_path: Path) -> None:
    for name in ("rtt_1.csv", "wsr_1.csv", "wsr_2.csv", "uwb_1.csv"):
        (tmp_path / name).touch()
    assert {job.path.stem for job in jobs_in(tmp_path)} == {"wsr_1", "wsr_2"}
