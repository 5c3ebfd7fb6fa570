from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from companion.mav.payloads import (
    ParamEncoding,
    ParamType,
    RawParamValue,
    raw_of,
    raw_value,
    value_from_raw,
)

BYTEWISE, C_CAST = ParamEncoding.BYTEWISE, ParamEncoding.C_CAST
INTEGERS = [kind for kind in ParamType if kind.is_integer]


@pytest.mark.parametrize("kind", INTEGERS)
@given(data=st.data())
def test_every_integer_survives_bytewise(kind: ParamType, data: st.DataObject) -> None:
    least, greatest = kind.bounds
    value = data.draw(st.integers(int(least), int(greatest)))
    assert value_from_raw(raw_value(value, kind, BYTEWISE), kind, BYTEWISE) == value


@pytest.mark.parametrize("kind", INTEGERS)
@given(data=st.data())
def test_integers_of_up_to_24_bits_survive_a_cast(kind: ParamType, data: st.DataObject) -> None:
    least, greatest = kind.bounds
    value = data.draw(st.integers(max(-(2**24), int(least)), min(2**24, int(greatest))))
    assert value_from_raw(raw_value(value, kind, C_CAST), kind, C_CAST) == value


@given(raw=st.binary(min_size=4, max_size=4))
def test_the_four_bytes_travel_unchanged_even_where_they_are_a_nan(raw: bytes) -> None:
    frame = MavCodec(1, 1).encode(RawParamValue("A_NAME", raw, 6, 10, 3))
    (message,) = MavCodec(255, 190).decode(frame)
    assert raw_of(message) == raw
    assert isinstance(message, mavlink.MAVLink_param_value_message)
    assert (message.param_id, message.param_count, message.param_index) == ("A_NAME", 10, 3)


def test_a_small_negative_integer_is_a_nan_as_a_float_and_still_itself() -> None:
    raw = raw_value(-2, ParamType.INT32, BYTEWISE)
    assert math.isnan(struct.unpack("<f", raw)[0])
    assert value_from_raw(raw, ParamType.INT32, BYTEWISE) == -2


def test_a_frame_is_the_same_as_pymavlinks_where_the_value_is_a_plain_float() -> None:
    ours = RawParamValue("SIXTEEN_LETTERS_", raw_value(2.5, ParamType.REAL32, C_CAST), 9, 4, 2)
    theirs = mavlink.MAVLink_param_value_message(b"SIXTEEN_LETTERS_", 2.5, 9, 4, 2)
    assert MavCodec(1, 1).encode(ours) == MavCodec(1, 1).encode(theirs)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("kind", [ParamType.INT8, ParamType.REAL32])
def test_what_is_not_finite_stays_so_and_does_not_raise(kind: ParamType, bad: float) -> None:
    assert not math.isfinite(value_from_raw(struct.pack("<f", bad), kind, C_CAST))


@pytest.mark.parametrize(("real", "whole"), [(3.0, 3), (2.995, 3), (3.4, 3), (-3.4, -3)])
def test_a_cast_cuts_as_ardupilot_does(real: float, whole: int) -> None:
    assert value_from_raw(struct.pack("<f", real), ParamType.INT16, C_CAST) == whole
