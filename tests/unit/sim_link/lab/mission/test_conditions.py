"""Conditions: what they say, what is refused, and what becomes of the unknown."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_link.lab.mission.conditions import FIELDS, ConditionError, FlightSituation, parse_condition


@pytest.fixture
def flying() -> FlightSituation:
    situation = FlightSituation()
    situation.vehicle.mode = "offboard"
    situation.vehicle.is_armed = True
    situation.vehicle.height_m = 19.5
    situation.estimate.r95_m = 2.5
    situation.estimate.state = "ambiguous"
    situation.estimate.error_m = 1.5
    situation.companion_texts.append("hold: no ranging for 5 s")
    return situation


@pytest.mark.parametrize(
    "text",
    [
        "vehicle.is_armed",
        "vehicle.height_m > 19",
        "vehicle.mode == offboard",
        'vehicle.mode == "offboard"',
        "vehicle.mode != hold",
        "vehicle.height_m > 15 and vehicle.height_m <= 19.5",
        "not vehicle.mode == hold",
        "vehicle.height_m > 100 or estimate.r95_m < 3",
        "vehicle.height_m > 10 and estimate.state == localised or estimate.state == ambiguous",
        "vehicle.is_armed or vehicle.height_m > 100 and estimate.r95_m > 3",
        "estimate.error_m <= estimate.r95_m",
        "vehicle.height_m > -3",
        'said("no ranging")',
        'not autopilot_said("no ranging")',
        "vehicle.is_armed == true",
    ],
)
def test_a_condition_that_holds(flying: FlightSituation, text: str) -> None:
    assert parse_condition(text).holds(flying)


@pytest.mark.parametrize(
    "text",
    [
        "not vehicle.is_armed",
        "vehicle.height_m > 19.5",
        "vehicle.mode == hold",
        "vehicle.height_m > 19.6 and vehicle.height_m < 30",
        "estimate.r95_m < 2 or vehicle.height_m < 3",
        'said("LOCALISED")',
        'said("no ranging and more")',
        "vehicle.is_armed != true",
    ],
)
def test_a_condition_that_does_not_hold(flying: FlightSituation, text: str) -> None:
    assert not parse_condition(text).holds(flying)


@pytest.mark.parametrize(
    "text",
    [
        "vehicle.battery > 0.5",
        "not vehicle.battery > 0.5",
        "vehicle.battery != 3",
        "vehicle.is_armed and vehicle.battery > 0.5",
        "vehicle.mode == hold or vehicle.battery > 0.5",
        "vehicle.battery == vehicle.battery",
    ],
)
def test_what_is_unknown_neither_holds_nor_fails(flying: FlightSituation, text: str) -> None:
    assert not parse_condition(text).holds(flying)


def test_an_unknown_decides_nothing_where_the_rest_decides(flying: FlightSituation) -> None:
    assert parse_condition("vehicle.battery > 0.5 or vehicle.is_armed").holds(flying)
    assert parse_condition("vehicle.battery > 0.5 and vehicle.mode == hold").is_false(flying)
    assert not parse_condition("vehicle.battery > 0.5 or vehicle.mode == hold").is_false(flying)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("vehicle.heigth_m > 3", "did you mean vehicle.height_m?"),
        ("height_m > 3", "did you mean vehicle.height_m?"),
        ("vehicle.height_m", "is a number; compare it"),
        ("vehicle.mode == flying", "is never `flying`; it is one of offboard, hold"),
        ("vehicle.mode < hold", "has no order"),
        ("vehicle.mode == 3", "compares a word with a number"),
        ("vehicle.is_armed == 1", "compares true or false with a number"),
        ("vehicle.height_m >", "is no comparison"),
        ("vehicle.height_m = 3", "is no comparison"),
        ("3 < vehicle.height_m < 5", "is no comparison"),
        ("hold", "is not known here"),
        ("hold == land", "is not known here"),
        ("vehicle.height_m > hold", "is not known here"),
        ("vehicle.height_m > inf", "is no finite number"),
        ("vehicle.height_m / 2 > 2", "is no comparison"),
        ("vehicle.mode in 'hold'", "is no comparison"),
        ("__import__('os')", "is no comparison"),
        ("said(vehicle.mode)", "is no comparison"),
        ("vehicle.mode.upper() == 'HOLD'", "is no comparison"),
        ("not vehicle.mode", "is a word; compare it"),
        ("vehicle.is_armed and", "is no comparison"),
        ("x" * 2000, "longer than"),
        ("", "is no comparison"),
    ],
)
def test_a_condition_that_makes_no_sense_is_refused(text: str, complaint: str) -> None:
    with pytest.raises(ConditionError) as caught:
        parse_condition(text)
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)


def test_every_field_can_be_read() -> None:
    situation = FlightSituation()
    for name, info in FIELDS.items():
        text = f"{name} == {name}"
        parse_condition(text).holds(situation)
        for word in info.words:
            parse_condition(f'{name} == "{word}"').holds(situation)


@given(st.text(max_size=80))
def test_no_text_does_anything_but_parse_or_be_refused(text: str) -> None:
    try:
        condition = parse_condition(text)
    except ConditionError:
        return
    condition.holds(FlightSituation())
