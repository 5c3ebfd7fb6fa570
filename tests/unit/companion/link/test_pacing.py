from __future__ import annotations

import msgspec
import pytest

from companion.link.interface import LinkParams
from companion.link.quality import CALM_S, Pacing


def paced(*observed: tuple[float | None, float]) -> Pacing:
    pacing = Pacing(LinkParams())
    for loss, now_s in observed:
        pacing.observe(loss, now_s)
    return pacing


def test_twenty_a_second_on_a_good_line() -> None:
    assert paced((0.0, 1.0), (0.1, 2.0), (0.2, 3.0)).period_s == pytest.approx(0.05)


def test_fifty_a_second_where_more_than_a_fifth_is_lost() -> None:
    assert paced((0.21, 1.0)).period_s == pytest.approx(0.02)


def test_an_unknown_loss_changes_nothing() -> None:
    assert paced((None, 1.0)).period_s == pytest.approx(0.05)
    assert paced((0.3, 1.0), (None, 9.0)).period_s == pytest.approx(0.02)


def test_the_rate_goes_down_only_after_calm_for_a_while() -> None:
    pacing = paced((0.3, 0.0), (0.05, 1.0), (0.05, 1.0 + CALM_S - 0.1))
    assert pacing.is_lossy
    pacing.observe(0.05, 1.0 + CALM_S)
    assert not pacing.is_lossy


@pytest.mark.parametrize("between", [0.1, 0.15, 0.2])
def test_a_line_between_calm_and_lossy_keeps_its_rate(between: float) -> None:
    assert not paced((between, 0.0), (between, 100.0)).is_lossy
    assert paced((0.3, 0.0), (between, 1.0), (between, 100.0)).is_lossy


def test_one_bad_moment_begins_the_calm_again() -> None:
    pacing = paced((0.3, 0.0), (0.0, 1.0), (0.15, 5.9), (0.0, 6.0), (0.0, 6.1))
    assert pacing.is_lossy


@pytest.mark.parametrize(
    "wrong",
    [
        {"rate_hz": 10.0},
        {"rate_hz": 60.0},
    ],
)
def test_rates_that_make_no_sense_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(wrong, LinkParams)
