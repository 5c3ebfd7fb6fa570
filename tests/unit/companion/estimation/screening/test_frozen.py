"""A value that stands still while the vehicle moves."""

from __future__ import annotations

import pytest

from companion.estimation.screen import (
    FROZEN_COUNT,
    FROZEN_M,
    FROZEN_S,
    FrozenValue,
)


def _fed(
    value: FrozenValue, numbers: list[float], speed_mps: float, rate_hz: float = 10.0
) -> list[bool]:
    return [
        value.add(number, i / rate_hz, (speed_mps * i / rate_hz, 0.0, 20.0))
        for i, number in enumerate(numbers)
    ]


def test_a_radio_that_hangs_is_reported_within_a_second() -> None:
    frozen = _fed(FrozenValue(), [50.0 + 0.1 * i for i in range(10)] + [51.0] * 30, 5.0)
    assert frozen.index(True) == 10 + round(10 * FROZEN_S)
    assert all(frozen[20:])


def test_a_new_value_is_no_frozen_one() -> None:
    value = FrozenValue()
    assert any(_fed(value, [51.0] * 20, 5.0))
    assert not value.add(51.3, 3.0, (15.0, 0.0, 20.0))
    assert not any(_fed(value, [51.0] * 5, 5.0))


def test_hovering_it_may_repeat_itself() -> None:
    assert not any(_fed(FrozenValue(), [51.0] * 100, 0.01))


@pytest.mark.parametrize("speed_mps", [0.5, 5.0])
def test_it_takes_time_and_motion_and_some_values(speed_mps: float) -> None:
    frozen = _fed(FrozenValue(), [51.0] * 100, speed_mps)
    needed_s = max(FROZEN_S, FROZEN_M / speed_mps)
    assert frozen.index(True) == pytest.approx(10 * needed_s, abs=1)
    slow = _fed(FrozenValue(), [51.0] * 10, speed_mps, rate_hz=0.5)
    assert slow.index(True) == FROZEN_COUNT - 1


def test_a_coarse_radio_changes_often_enough() -> None:
    """Half metres, at 30 m and flying at the target."""
    numbers = [round(2.0 * (30.0 - 0.3 * i)) / 2.0 for i in range(60)]
    assert not any(_fed(FrozenValue(), numbers, 3.0))
