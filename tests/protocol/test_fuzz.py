"""Random frames against the simulator: a few thousand, and in the campaign a million."""

from __future__ import annotations

import gc
from pathlib import Path

import numpy as np
import pytest

from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from companion.mav.endpoint import Chunk
from sim_link.lab.conformance.rules import Flavour
from tests.protocol.conformance_rigs import simulator
from tests.protocol.frame_fuzzer import FrameFuzzer, FuzzCampaign, FuzzFailure, Meant
from tests.protocol.tampered import Tampered, set_byte

FRAMES = 8_000
FLAVOURS = pytest.mark.parametrize("flavour", list(Flavour), ids=lambda flavour: flavour.value)


def in_use() -> tuple[float, int]:
    """Resident megabytes and objects of the interpreter."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * 4096 / 1e6, len(gc.get_objects())


@pytest.mark.campaign
@FLAVOURS
def test_half_a_million_random_frames_break_nothing_and_take_no_memory(flavour: Flavour) -> None:
    campaign = FuzzCampaign(lambda: simulator(flavour), np.random.default_rng(1), flavour)
    campaign.run(100_000)
    settled_mb, settled = in_use()
    campaign.run(400_000)
    resident_mb, objects = in_use()
    assert resident_mb - settled_mb <= 16.0
    assert objects - settled <= 20_000


@pytest.mark.slow
@FLAVOURS
@pytest.mark.parametrize("seed", [1])
def test_random_frames_break_nothing_and_those_for_others_change_nothing(
    flavour: Flavour, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    campaign = FuzzCampaign(lambda: simulator(flavour), rng, flavour)
    campaign.run(FRAMES)
    assert campaign.answers > FRAMES / 10


@FLAVOURS
def test_frames_have_right_checksums_unless_they_are_broken(flavour: Flavour) -> None:
    fuzzer, codec = FrameFuzzer(np.random.default_rng(1), flavour), MavCodec(1, 1)
    pieces = [fuzzer.next() for _ in range(2_000)]
    whole = [piece for piece in pieces if piece.meant is not Meant.NO_FRAME]
    for piece in whole:
        codec.decode(piece.data)
    assert codec.counters.good == len(whole)
    assert codec.counters.bad_crc == 0
    assert {piece.meant for piece in pieces} == set(Meant)


def test_a_vehicle_that_obeys_what_is_for_others_is_found() -> None:
    count = 0

    def make() -> Tampered:
        nonlocal count
        count += 1
        return Tampered(simulator(Flavour.ARDUPILOT), set_byte(76, 30, 1))

    with pytest.raises(FuzzFailure, match="another system"):
        FuzzCampaign(make, np.random.default_rng(1), Flavour.ARDUPILOT).run(FRAMES)
    assert count == 2


def test_a_vehicle_that_raises_is_found() -> None:
    class Fragile(Tampered):
        def receive(self, chunk: Chunk, now_s: float) -> None:
            del now_s
            if b"\xff" in chunk.data:
                raise ValueError("too many ones")

    rng = np.random.default_rng(1)
    campaign = FuzzCampaign(lambda: Fragile(simulator(Flavour.PX4)), rng, Flavour.PX4)
    with pytest.raises(FuzzFailure, match="ValueError: too many ones"):
        campaign.run(FRAMES)


def test_signing_setup_is_left_out() -> None:
    fuzzer, codec = FrameFuzzer(np.random.default_rng(3), Flavour.PX4), MavCodec(1, 1)
    heard = [m for _ in range(3_000) for m in codec.decode(fuzzer.next().data)]
    assert not [m for m in heard if isinstance(m, mavlink.MAVLink_setup_signing_message)]
