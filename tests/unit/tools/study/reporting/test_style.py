from __future__ import annotations

import re
from itertools import pairwise

import pytest

from tools.study.reporting.plots import THEMED, finished, inline, look, losses, spread


def test_labels_that_do_not_collide_stay() -> None:
    assert spread([0.1, 0.5, 0.9], 0.1) == pytest.approx([0.1, 0.5, 0.9])


def test_labels_that_collide_are_spread_about_their_middle() -> None:
    assert spread([0.5, 0.5, 0.5], 0.1) == pytest.approx([0.4, 0.5, 0.6])


def test_a_spread_group_pushes_its_neighbour() -> None:
    values = spread([0.40, 0.44, 0.52], 0.1)
    assert [b - a for a, b in pairwise(values)] == pytest.approx([0.1, 0.1])
    assert sum(values) == pytest.approx(0.40 + 0.44 + 0.52)


@pytest.mark.slow
def test_a_figure_is_the_same_bytes_twice_and_follows_the_pages_theme() -> None:
    drawings = []
    for _ in range(2):
        with look():
            drawings.append(finished(losses(), "losses", "Losses", "What they cost."))
    assert drawings[0].svg == drawings[1].svg
    assert drawings[0].png == drawings[1].png
    text = inline(drawings[0])
    assert not any(colour in text for colour in THEMED)
    assert "var(--latched)" in text
    assert "<metadata>" not in text
    used = set(re.findall(r'(?:url\(|href=")#([^)"]+)', text))
    assert used <= set(re.findall(r'\bid="([^"]+)"', text))
    assert all(name.startswith("losses-") for name in used)
