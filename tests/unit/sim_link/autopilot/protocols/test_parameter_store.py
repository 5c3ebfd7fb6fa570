from __future__ import annotations

import math

import pytest

from companion.errors import ConfigError
from companion.mav.payloads import ParamEncoding, ParamType
from sim_link.autopilot.ardupilot.firmware_profile import ARDUPILOT_PARAMETERS
from sim_link.autopilot.protocols.parameter_protocol import ParameterStore, ParamSpec
from sim_link.autopilot.px4.firmware_profile import PX4_PARAMETERS

ACTION = ParamSpec("ACTION", ParamType.INT32, 2, 0, 5)
ALTITUDE = ParamSpec("ALTITUDE", ParamType.REAL32, 2.5, 0.0, 80.0, "m")
FLOWN = ParamSpec("FLOWN", ParamType.INT16, 0, is_read_only=True)


@pytest.fixture
def store() -> ParameterStore:
    return ParameterStore((ACTION, ALTITUDE, FLOWN))


def test_values_begin_with_their_defaults_or_what_is_given() -> None:
    store = ParameterStore((ACTION, ALTITUDE), {"ACTION": 4})
    assert (store["ACTION"], store["ALTITUDE"]) == (4, 2.5)


def test_an_initial_value_is_no_change_to_be_saved() -> None:
    assert "ACTION" not in ParameterStore((ACTION,), {"ACTION": 4}).to_text()


def test_a_change_raises_the_revision_and_an_equal_value_does_not(store: ParameterStore) -> None:
    store.set("ACTION", 3)
    store.set("ACTION", 3.0)
    assert (store["ACTION"], store.revision) == (3, 1)


@pytest.mark.parametrize("value", [math.nan, math.inf, -0.1, 80.1, 1e39])
def test_a_real_that_may_not_be_is_refused(store: ParameterStore, value: float) -> None:
    with pytest.raises(ConfigError, match="parameter ALTITUDE"):
        ParameterStore(store.specs, {"ALTITUDE": value})


@pytest.mark.parametrize("value", [2.5, -1, 6])
def test_an_integer_that_may_not_be_is_refused(store: ParameterStore, value: float) -> None:
    assert ACTION.problem_with(value) is not None
    with pytest.raises(ConfigError, match="parameter ACTION"):
        ParameterStore(store.specs, {"ACTION": value})


def test_the_bounds_of_a_type_hold_where_none_are_given() -> None:
    assert FLOWN.problem_with(32_768) == "not within -32768 to 32767"


def test_a_real_is_kept_as_it_will_be_on_the_wire(store: ParameterStore) -> None:
    store.set("ALTITUDE", 0.1)
    assert store["ALTITUDE"] == pytest.approx(0.1, rel=1e-7)
    assert store["ALTITUDE"] != 0.1


@pytest.mark.parametrize(
    "specs",
    [
        (ACTION, ACTION),
        (ParamSpec("SEVENTEEN_LETTERS", ParamType.INT32, 0),),
        (ParamSpec("", ParamType.INT32, 0),),
        (ParamSpec("BEYOND", ParamType.INT8, 200),),
    ],
)
def test_a_wrong_table_is_refused(specs: tuple[ParamSpec, ...]) -> None:
    with pytest.raises(ConfigError):
        ParameterStore(specs)


def test_an_unknown_initial_name_is_refused() -> None:
    with pytest.raises(ConfigError, match="NOBODY"):
        ParameterStore((ACTION,), {"NOBODY": 1})


# Files


def test_what_was_saved_is_loaded(store: ParameterStore) -> None:
    store.set("ALTITUDE", 0.15)
    store.set("ACTION", 5)
    text = store.to_text()
    assert text.splitlines()[1:] == ["ACTION 5", "ALTITUDE 0.15"]
    again = ParameterStore((ACTION, ALTITUDE, FLOWN))
    again.load_text(text, "vehicle.parm")
    assert (again["ACTION"], again["ALTITUDE"]) == (5, store["ALTITUDE"])
    assert again.to_text() == text


def test_commas_comments_and_blank_lines_are_read(store: ParameterStore) -> None:
    store.load_text("# mine\n\nACTION,3  # three\n  ALTITUDE\t7\n", "f")
    assert (store["ACTION"], store["ALTITUDE"]) == (3, 7)


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("NOBODY 1", "no parameter `NOBODY`"),
        ("ACTION", "NAME VALUE"),
        ("ACTION 1 2", "NAME VALUE"),
        ("ACTION six", "must be a number"),
        ("ACTION 3000000000", "not within"),
        ("ACTION nan", "not a number"),
        ("ALTITUDE 1e300", "not within"),
        ("ACTION 1.5", "not a whole number"),
        ("FLOWN 1", "read-only"),
    ],
)
def test_a_bad_line_is_named_and_nothing_is_taken(
    store: ParameterStore, line: str, problem: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        store.load_text(f"ALTITUDE 9\n{line}\n", "vehicle.parm")
    assert str(caught.value).startswith("vehicle.parm, line 2: ")
    assert problem in str(caught.value)
    assert "\n" not in str(caught.value)
    assert (store["ALTITUDE"], store.revision) == (2.5, 0)


# The tables of the autopilots


@pytest.mark.parametrize("table", [PX4_PARAMETERS, ARDUPILOT_PARAMETERS])
def test_every_default_of_a_table_is_allowed(table: tuple[ParamSpec, ...]) -> None:
    assert len(ParameterStore(table)) == len(table)


def test_px4_has_only_int32_and_real32() -> None:
    assert {spec.kind for spec in PX4_PARAMETERS} == {ParamType.INT32, ParamType.REAL32}


def test_px4_numbers_by_name() -> None:
    names = [spec.name for spec in PX4_PARAMETERS]
    assert names == sorted(names)


def test_ardupilot_uses_types_2_4_6_and_9() -> None:
    assert {int(spec.kind) for spec in ARDUPILOT_PARAMETERS} == {2, 4, 6, 9}


@pytest.mark.parametrize(
    ("table", "names"),
    [
        (
            PX4_PARAMETERS,
            "MIS_TAKEOFF_ALT RTL_RETURN_ALT COM_OF_LOSS_T COM_OBL_RC_ACT MPC_XY_VEL_MAX "
            "MPC_Z_VEL_MAX_UP MPC_Z_VEL_MAX_DN GF_ACTION GF_MAX_HOR_DIST GF_MAX_VER_DIST "
            "NAV_DLL_ACT NAV_RCL_ACT COM_RC_IN_MODE COM_DISARM_LAND BAT_LOW_THR BAT_CRIT_THR "
            "COM_LOW_BAT_ACT SYS_AUTOSTART MAV_SYS_ID MPC_XY_CRUISE",
        ),
        (
            ARDUPILOT_PARAMETERS,
            "GUID_TIMEOUT FENCE_ENABLE FENCE_TYPE FENCE_ACTION FENCE_ALT_MAX FENCE_RADIUS "
            "FS_GCS_ENABLE BATT_FS_LOW_ACT BATT_LOW_VOLT RTL_ALT WPNAV_SPEED WPNAV_SPEED_UP "
            "WPNAV_SPEED_DN DISARM_DELAY ARMING_CHECK SYSID_THISMAV SYSID_MYGCS PILOT_SPEED_UP",
        ),
    ],
)
def test_the_names_that_clients_ask_for_are_there(table: tuple[ParamSpec, ...], names: str) -> None:
    assert set(names.split()) <= {spec.name for spec in table}


def test_the_hash_changes_with_any_value(store: ParameterStore) -> None:
    before = store.hash()
    store.set("ALTITUDE", 2.6)
    assert store.hash() != before
    store.set("ALTITUDE", 2.5)
    assert store.hash() == before


def test_raw_bytes_follow_the_encoding(store: ParameterStore) -> None:
    assert store.raw_at(0, ParamEncoding.BYTEWISE) == b"\x02\x00\x00\x00"
    assert store.raw_at(0, ParamEncoding.C_CAST) == b"\x00\x00\x00\x40"
