from __future__ import annotations

import numpy as np

from companion.estimation.target_motion import TargetMotion
from companion.guidance.commands import Severity
from companion.guidance.messages import MotionMessages

WALKING = TargetMotion(np.array([0.6, 0.8]), 99.0)


def test_a_walk_is_reported_once_and_so_is_its_end() -> None:
    news = MotionMessages()
    assert news.messages_for(1, None) == []
    (began,) = news.messages_for(1, WALKING)
    assert began.severity is Severity.WARNING
    assert "move at 1.0 m/s" in began.text
    assert news.messages_for(1, WALKING) == []
    (ended,) = news.messages_for(1, None)
    assert ended.severity is Severity.INFO
    assert news.messages_for(1, None) == []


def test_each_emitter_has_news_of_its_own() -> None:
    news = MotionMessages()
    news.messages_for(1, WALKING)
    assert len(news.messages_for(2, WALKING)) == 1
    assert len(news.messages_for(1, None)) == 1
    assert news.messages_for(2, WALKING) == []
