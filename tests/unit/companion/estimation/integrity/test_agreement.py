"""Detection of almost no agreement with the estimate, and of its return."""

from __future__ import annotations

from companion.estimation.integrity import PROVEN_COUNT, TrackIntegrity


def _fed(integrity: TrackIntegrity, count: int, start_s: float, *, agrees: bool) -> list[float]:
    """Ten a second; when agreement was lost."""
    lost_s = []
    for step in range(count):
        time_s = start_s + 0.1 * step
        integrity.note_agreement(time_s, agrees=agrees)
        if integrity.is_lost:
            lost_s.append(time_s - start_s)
    return lost_s


def test_a_run_of_contradictions_is_reported_within_two_seconds() -> None:
    integrity = TrackIntegrity()
    assert _fed(integrity, 100, 0.0, agrees=True) == []
    lost_s = _fed(integrity, 30, 10.0, agrees=False)
    assert 1.0 < lost_s[0] <= 2.0
    back = _fed(integrity, 30, 13.0, agrees=True)
    assert back
    assert 0.8 <= max(back) <= 1.2


def test_as_many_outliers_as_a_bad_radio_has_are_no_loss() -> None:
    integrity = TrackIntegrity()
    for step in range(400):
        integrity.note_agreement(0.1 * step, agrees=step % 5 > 1)
        assert not integrity.is_lost


def test_a_slow_radio_needs_ten_measurements() -> None:
    integrity = TrackIntegrity()
    for step in range(10):
        integrity.note_agreement(float(step), agrees=True)
    for step in range(10, 18):
        integrity.note_agreement(float(step), agrees=False)
        assert not integrity.is_lost
    integrity.note_agreement(18.0, agrees=False)
    assert integrity.is_lost


def test_an_estimate_proves_itself_by_what_agrees_with_it() -> None:
    integrity = TrackIntegrity()
    for step in range(2 * PROVEN_COUNT - 1):
        integrity.note_agreement(0.1 * step, agrees=step % 2 == 1)
    assert not integrity.is_proven
    integrity.note_agreement(99.0, agrees=True)
    assert integrity.is_proven
