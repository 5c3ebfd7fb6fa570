"""Frames that a signed link must accept, by the letter of the protocol."""

from __future__ import annotations

from sim_link.lab.monitor.independent_checks import Proof
from tests.unit.companion.mav.signing_helpers import KEY, NOW, OTHER_KEY, signed, unsigned


def test_a_frame_is_believed_once_and_an_older_one_never_after_it() -> None:
    proof = Proof(KEY)
    assert proof.accepts(signed(NOW))
    assert not proof.accepts(signed(NOW))
    assert not proof.accepts(signed(NOW - 1))
    assert proof.accepts(signed(NOW + 1))


def test_what_the_key_does_not_prove_is_not_believed() -> None:
    proof = Proof(KEY)
    assert not proof.accepts(unsigned())
    assert not proof.accepts(signed(NOW, OTHER_KEY))


def test_a_copy_of_a_frame_that_was_dropped_unread_is_the_first_of_its_kind() -> None:
    proof = Proof(KEY)
    assert proof.accepts(signed(NOW))
    assert proof.accepts(signed(NOW + 2))
    proof.dropped()
    assert proof.accepts(signed(NOW + 1))
    assert not proof.accepts(signed(NOW))
    proof.dropped()  # one that was refused leaves nothing to take back
    assert not proof.accepts(signed(NOW + 1))


def test_unreadable_frames_take_back_nothing() -> None:
    proof = Proof(KEY)
    assert proof.accepts(signed(NOW))
    proof.unreadable()
    proof.dropped()
    assert not proof.accepts(signed(NOW))
