from __future__ import annotations

import pytest

from tools.study.reporting.tables import (
    METRICS,
    metric_name,
    parameter_name,
    typeset,
    value_name,
)


@pytest.mark.parametrize(
    ("typed", "printed"),
    [
        ("0.217 to 0.473", "0.217\u2009\u2013\u20090.473"),
        ("<= 0.03 m", "\u2264 0.03\u00a0m"),
        ("true -3 deg", "true \u22123\u00a0deg"),
        ("at most 0.5 x the paper's", "at most 0.5 \u00d7 the paper\u2019s"),
        ("-", "\u2013"),
        ("one-sided, k-5", "one-sided, k-5"),
    ],
)
def test_text_is_set_with_the_signs_of_print(typed: str, printed: str) -> None:
    assert typeset(typed) == printed


def test_an_unknown_parameter_keeps_its_name() -> None:
    assert parameter_name("eps_stop_m") == "eps stop m"
    assert value_name("eps_stop_m", "1.0") == "eps stop m 1.0"


def test_a_metric_of_some_step_says_which() -> None:
    assert metric_name("rmse_after_24_steps_m").startswith("RMSE after 24 steps")
    assert metric_name("bound_ratio") == METRICS["bound_ratio"]
