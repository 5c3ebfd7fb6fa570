"""The language of conditions: what it says, what it refuses, and what it makes of the unknown."""

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
        "offboard == vehicle.mode",
        "vehicle.mode != hold",
        "15 < vehicle.height_m <= 19.5",
        "not vehicle.mode == hold",
        "vehicle.height_m > 100 or estimate.r95_m < 3",
        "vehicle.height_m > 10 and (estimate.state == localised or estimate.state == ambiguous)",
        "estimate.error_m <= 2 * estimate.r95_m - 1",
        "abs(estimate.error_m - 2) < 1",
        "vehicle.height_m > -3",
        'said("no ranging")',
        'not autopilot_said("no ranging")',
        "vehicle.is_armed == true",
        "true",
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
        "19.6 < vehicle.height_m < 30",
        "estimate.r95_m < 2 or vehicle.height_m < 3",
        'said("LOCALISED")',
        "false",
    ],
)
def test_a_condition_that_does_not_hold(flying: FlightSituation, text: str) -> None:
    assert not parse_condition(text).holds(flying)


@pytest.mark.parametrize(
    "text",
    [
        "vehicle.battery > 0.5",
        "not vehicle.battery > 0.5",
        "vehicle.battery + 1 != 3",
        "vehicle.is_armed and vehicle.battery > 0.5",
        "not (vehicle.is_armed and vehicle.battery > 0.5)",
        "0.1 < vehicle.battery < 0.9",
        "vehicle.battery == vehicle.battery",
    ],
)
def test_what_is_unknown_neither_holds_nor_fails(flying: FlightSituation, text: str) -> None:
    assert not parse_condition(text).holds(flying)


def test_an_unknown_decides_nothing_where_the_rest_decides(flying: FlightSituation) -> None:
    assert parse_condition("vehicle.battery > 0.5 or vehicle.is_armed").holds(flying)
    assert parse_condition("not (vehicle.battery > 0.5 and vehicle.mode == hold)").holds(flying)
    assert parse_condition("not (0.5 < vehicle.battery and 20 < vehicle.height_m)").holds(flying)


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
        ("vehicle.height_m >", "not a condition (column"),
        ("vehicle.height_m = 3", "not a condition (column"),
        ("hold", "is not known here"),
        ("hold == land", "is not known here"),
        ("hold + 1 > 2", "is not known here"),
        ("vehicle.mode + 1 > 2", "a number is needed here"),
        ("vehicle.height_m / 2 > 2", "something else than + - *"),
        ("vehicle.mode in 'hold'", "something else than < <="),
        ("__import__('os')", "is not a function here"),
        ("abs(3, 4) > 2", "is not a function here"),
        ("said(vehicle.mode)", "needs a text in quotes"),
        ("vehicle.mode.upper() == 'HOLD'", "is not a function here"),
        ("[1][0] > 0", "is not part of the language"),
        ("lambda: 1", "is not part of the language"),
        ("vehicle.height_m > 3j", "is not a number"),
        ("not vehicle.mode", "is a word; compare it"),
        ("x" * 2000, "longer than"),
        ("", "not a condition"),
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
