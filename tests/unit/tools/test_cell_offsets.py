"""A cell's constant delay: never localised beside R95, and no difference once it is calibrated."""

from __future__ import annotations

import pytest

from tools.campaign.cell_offsets import preset_with, walk

SEEDS = range(4)


@pytest.mark.parametrize(
    "offset", [0, 25, *(pytest.param(n, marks=pytest.mark.slow) for n in (3, 13))]
)
def test_a_constant_that_is_not_calibrated_is_never_localised(offset: int) -> None:
    config = preset_with(None)

    assert not any(walk(config, offset, seed).is_localised for seed in SEEDS)


@pytest.mark.slow
def test_a_calibrated_constant_changes_nothing() -> None:
    without = [walk(preset_with(0), 0, seed) for seed in SEEDS]

    assert any(each.is_localised for each in without)
    assert not any(each.is_outside for each in without)
    for offset in (3, 25):
        found = [walk(preset_with(offset), offset, seed) for seed in SEEDS]
        for one, other in zip(without, found, strict=True):
            assert one.is_localised is other.is_localised
            assert other.error_m == pytest.approx(one.error_m, rel=1e-6)
            assert other.r95_m == pytest.approx(one.r95_m, rel=1e-6)
