"""A memory in bytes: comes back as it was, or not at all."""

from __future__ import annotations

import random
import struct
import zlib
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from companion.domain import DEFAULT_ACCURACY, Autopilot, EstimateState, TargetEstimate
from companion.estimation.belief import Belief, StoredHypothesis
from companion.geometry.coordinates import LocalOrigin
from companion.guidance.commands import ReportResult
from companion.guidance.events import SessionMemory, VehicleMark
from companion.guidance.phases import Phase
from companion.io.checkpoints import (
    MAX_BYTES,
    Checkpoint,
    CheckpointError,
    MissionKey,
    Moment,
    age_s,
    decode_checkpoint,
    decode_memory,
    encode_checkpoint,
    encode_memory,
)

ESTIMATE = TargetEstimate(
    time_s=60.0,
    state=EstimateState.LOCALISED,
    position_enu_m=(12.0, 34.0),
    covariance_m2=((0.04, 0.0), (0.0, 0.04)),
    r95_m=0.5,
    range_offset_m=1.0,
    bearing_offset_rad=0.1,
    measurements=500,
    alternative_enu_m=(1.0, 2.0),
)


def a_checkpoint(hypotheses: int = 1, sequence: int = 7) -> Checkpoint:
    rng = np.random.default_rng(hypotheses)
    identity = tuple(tuple(row) for row in np.eye(4).tolist())
    belief = Belief(
        1,
        321,
        tuple(
            StoredHypothesis(-float(n), tuple(rng.normal(size=4).tolist()), identity)
            for n in range(hypotheses)
        ),
    )
    return Checkpoint(
        sequence,
        Moment(1_795_229_400.25, "5f0d", 1234.5),
        MissionKey(1, Autopilot.PX4, "fence", "mission"),
        SessionMemory(
            Phase.NORMAL,
            LocalOrigin(47.4, 8.5, 488.0),
            belief,
            ReportResult(ESTIMATE, 47.4, 8.5),
        ),
        VehicleMark(1, 1, "a1", 812.25),
    )


def test_a_memory_of_several_emitters_comes_back() -> None:
    one = a_checkpoint()
    assert one.memory.belief is not None
    other = replace(one.memory.belief, emitter_id=9)
    memory = replace(one.memory, others=(other,), earlier=(ReportResult(ESTIMATE, 47.4, 8.5, 9),))
    several = replace(one, memory=memory)
    assert decode_checkpoint(encode_checkpoint(several)) == several


@pytest.mark.parametrize("hypotheses", [1, 2, 24])
def test_a_checkpoint_comes_back_as_it_was(hypotheses: int) -> None:
    data = encode_checkpoint(a_checkpoint(hypotheses))
    assert decode_checkpoint(data) == a_checkpoint(hypotheses)
    assert len(data) < 8000


def test_a_memory_of_nothing_comes_back() -> None:
    empty = replace(a_checkpoint(), memory=SessionMemory(Phase.WAITING, None, None, None))
    assert decode_checkpoint(encode_checkpoint(empty)) == empty


def test_a_checkpoint_that_was_cut_off_anywhere_is_refused() -> None:
    data = encode_checkpoint(a_checkpoint())
    for length in range(len(data)):
        with pytest.raises(CheckpointError):
            decode_checkpoint(data[:length])


def test_a_checkpoint_with_any_byte_changed_in_any_way_is_refused() -> None:
    data = encode_checkpoint(a_checkpoint())
    changes = [1 << bit for bit in range(8)] + [0xFF, 0x55]
    for index in range(len(data)):
        for change in changes:
            flipped = bytearray(data)
            flipped[index] ^= change
            with pytest.raises(CheckpointError):
                decode_checkpoint(bytes(flipped))


def test_a_checkpoint_with_something_behind_it_is_refused() -> None:
    data = encode_checkpoint(a_checkpoint())
    for more in (b"\0", data):
        with pytest.raises(CheckpointError):
            decode_checkpoint(data + more)


def test_random_bytes_are_no_checkpoint() -> None:
    rng = random.Random(5)
    for _ in range(2000):
        with pytest.raises(CheckpointError):
            decode_checkpoint(rng.randbytes(rng.randrange(400)))
    with pytest.raises(CheckpointError, match="bytes"):
        decode_checkpoint(bytes(MAX_BYTES + 1))


def with_payload(payload: bytes, version: int = 1) -> bytes:
    head = struct.pack("<4sHHI", b"CkPt", version, 0, len(payload)) + payload
    return head + struct.pack("<I", zlib.crc32(head))


def test_another_version_is_named() -> None:
    payload = encode_checkpoint(a_checkpoint())[12:-4]
    assert decode_checkpoint(with_payload(payload)) == a_checkpoint()
    with pytest.raises(CheckpointError, match="of version 2; this is version 1"):
        decode_checkpoint(with_payload(payload, version=2))


def test_a_whole_file_with_another_content_is_refused() -> None:
    rng = random.Random(6)
    plain = msgspec.to_builtins(a_checkpoint())
    strange: list[object] = [None, -1, 2**80, float("nan"), "x", [], {}, [[]], True, b"\xff"]
    keys = [(key,) for key in plain] + [("memory", k) for k in plain["memory"]]
    keys += [("key", k) for k in plain["key"]] + [("saved", k) for k in plain["saved"]]
    refused = 0
    for path in keys:
        for value in strange:
            changed = msgspec.to_builtins(a_checkpoint())
            node = changed
            for key in path[:-1]:
                node = node[key]
            node[path[-1]] = value
            try:
                payload = msgspec.msgpack.encode(changed)
            except OverflowError:
                continue
            try:
                decoded = decode_checkpoint(with_payload(payload))
            except CheckpointError:
                refused += 1
            else:
                assert encode_checkpoint(decoded)
    assert refused > 100
    for _ in range(500):
        with pytest.raises(CheckpointError):
            decode_checkpoint(with_payload(rng.randbytes(rng.randrange(200))))


@pytest.mark.parametrize(
    "wrong",
    [
        replace(a_checkpoint(), sequence=-1),
        replace(a_checkpoint(), saved=Moment(float("nan"), "", 0.0)),
        replace(a_checkpoint(), saved=Moment(0.0, "", float("inf"))),
        replace(a_checkpoint(), key=MissionKey(0, Autopilot.PX4, "", "")),
        replace(
            a_checkpoint(),
            memory=SessionMemory(Phase.NORMAL, LocalOrigin(200.0, 0.0, 0.0), None, None),
        ),
    ],
)
def test_an_impossible_checkpoint_is_refused(wrong: Checkpoint) -> None:
    with pytest.raises(CheckpointError, match="impossible"):
        decode_checkpoint(encode_checkpoint(wrong))


@pytest.mark.parametrize(
    ("now", "age"),
    [
        (Moment(2000.0, "a", 60.0), 10.0),
        (Moment(-9e9, "a", 60.0), 10.0),
        (Moment(2000.0, "a", 40.0), None),
        (Moment(1030.0, "b", 1.0), 30.0),
        (Moment(990.0, "b", 1.0), None),
        (Moment(1030.0, "", 60.0), 30.0),
    ],
)
def test_an_age_is_reported_by_the_kernels_clock_or_by_one_that_did_not_go_back(
    now: Moment, age: float | None
) -> None:
    assert age_s(Moment(1000.0, "a", 50.0), now) == age


def test_without_a_boot_id_the_wall_clock_counts() -> None:
    assert age_s(Moment(1000.0, "", 50.0), Moment(1005.0, "", 10.0)) == 5.0


def test_a_memory_from_before_the_absolute_radius_is_read_and_promises_no_more() -> None:
    report = ReportResult(ESTIMATE, 47.0, 8.0)
    memory = replace(a_checkpoint().memory, report=report)
    older = msgspec.msgpack.decode(encode_memory(memory))
    for name in ("own", "absolute_r95_m"):
        del older["report"]["estimate"][name]
    del older["belief"]["own"]
    read = decode_memory(msgspec.msgpack.encode(older))
    assert read.belief is not None
    assert read.belief.own is None
    assert read.report is not None
    assert read.report.estimate.own == DEFAULT_ACCURACY
    assert read.report.estimate.absolute_r95_m == pytest.approx(7.36, abs=0.01)
    assert decode_memory(encode_memory(memory)) == memory
