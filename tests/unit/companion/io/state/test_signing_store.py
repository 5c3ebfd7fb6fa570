"""Stored state of signing, against crashes, broken files and recorded frames."""

from __future__ import annotations

import json
import time
import zlib
from pathlib import Path

import pytest

from companion.errors import CompanionError, ConfigError
from companion.io.state_directory import CRASH_MARGIN_S, SigningKeeper, SigningStore
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from companion.mav.signing import (
    EPOCH_UNIX_S,
    ONE_LINK_EACH,
    TICKS_PER_S,
    LinkSigning,
    SignatureVerdict,
    Signing,
    SigningKey,
)

KEY = SigningKey(bytes(range(1, 33)))
NOW = 37_000_000_000_000
MINUTE = 60 * TICKS_PER_S
MARGIN = round(CRASH_MARGIN_S * TICKS_PER_S)


def opened(folder: Path, key: SigningKey = KEY) -> tuple[Signing, SigningStore]:
    store = SigningStore(folder / "signing.key", key)
    signing = store.signing(key, ONE_LINK_EACH)
    signing.advance(EPOCH_UNIX_S + NOW / TICKS_PER_S)
    return signing, store


def frames(count: int, begin: int = NOW) -> list[bytes]:
    """Return frames that the autopilot signs, from a timestamp on."""
    codec = MavCodec(1, 1, LinkSigning(Signing(KEY, begin - 1), 0))
    heartbeat = mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3)
    return [codec.encode(heartbeat) for _ in range(count)]


def fly(folder: Path, heard: list[bytes], *, is_killed: bool = False) -> list[SignatureVerdict]:
    """One run of the companion; how it judged what it heard."""
    signing, store = opened(folder)
    keeper = SigningKeeper(signing, store)
    verdicts = [signing.verify(frame) for frame in heard]
    keeper.keep(10.0)
    if is_killed:
        deadline_s = time.monotonic() + 30.0
        while keeper._replacer.written == 0 and time.monotonic() < deadline_s:
            time.sleep(0.001)  # the writer is a thread of its own
    else:
        keeper.close()
    return verdicts


def slots(folder: Path) -> list[Path]:
    return sorted(folder.glob("signing.key.time-*"))


def test_the_first_run_remembers_nothing(tmp_path: Path) -> None:
    signing, _ = opened(tmp_path)
    assert signing.timestamp == NOW
    assert signing.streams == {}


def test_what_was_heard_before_a_restart_is_a_replay_after_it(tmp_path: Path) -> None:
    recorded = frames(5)
    assert fly(tmp_path, recorded) == [SignatureVerdict.SIGNED] * 5
    assert fly(tmp_path, recorded) == [SignatureVerdict.REPLAYED] * 5
    assert fly(tmp_path, frames(1, NOW + 5)) == [SignatureVerdict.SIGNED]


def test_timestamps_of_our_own_go_on_from_the_stored_one(tmp_path: Path) -> None:
    fly(tmp_path, frames(5))
    signing, _ = opened(tmp_path)
    assert signing.timestamp == NOW + 4


def test_a_station_ahead_moves_our_clock_over_no_restart(tmp_path: Path) -> None:
    fly(tmp_path, frames(1, NOW + MINUTE))
    assert fly(tmp_path, frames(1, NOW + 2 * MINUTE)) == [SignatureVerdict.TOO_FAR_AHEAD]


def test_without_a_real_time_clock_the_stored_clock_goes_on(tmp_path: Path) -> None:
    fly(tmp_path, [])
    store = SigningStore(tmp_path / "signing.key", KEY)
    signing = store.signing(KEY, ONE_LINK_EACH)
    signing.advance(0.0)
    assert signing.verify(frames(1, NOW - MINUTE - 1)[0]) is SignatureVerdict.TOO_OLD
    assert signing.verify(frames(1, NOW + MINUTE)[0]) is SignatureVerdict.SIGNED


def test_a_memory_without_a_clock_begins_from_its_timestamp(tmp_path: Path) -> None:
    fly(tmp_path, frames(5))
    for path in slots(tmp_path):
        body = path.read_bytes().rpartition(b" ")[0]
        fields = json.loads(body)
        del fields["clock"]
        body = json.dumps(fields).encode()
        path.write_bytes(body + f" {zlib.crc32(body):08x}\n".encode())
    signing = SigningStore(tmp_path / "signing.key", KEY).signing(KEY, ONE_LINK_EACH)
    assert (signing.timestamp, signing.clock) == (NOW + 4, NOW + 4)


def test_after_a_crash_the_unstored_end_cannot_come_back_either(tmp_path: Path) -> None:
    recorded = frames(5)
    fly(tmp_path, recorded[:3], is_killed=True)
    signing, _ = opened(tmp_path)
    assert [signing.verify(frame) for frame in recorded] == [SignatureVerdict.REPLAYED] * 5
    assert signing.verify(frames(1, NOW + 2 + MARGIN)[0]) is SignatureVerdict.REPLAYED
    assert signing.verify(frames(1, NOW + 3 + MARGIN)[0]) is SignatureVerdict.SIGNED


def test_a_run_killed_at_once_has_the_margin_too(tmp_path: Path) -> None:
    fly(tmp_path, frames(5))
    signing, store = opened(tmp_path)
    SigningKeeper(signing, store)
    again, _ = opened(tmp_path)
    assert again.timestamp == NOW + 4 + MARGIN


@pytest.mark.parametrize("cut", ["empty", "half", "flipped", "another version"])
def test_one_broken_slot_costs_a_generation_and_no_more(tmp_path: Path, cut: str) -> None:
    recorded = frames(5)
    fly(tmp_path, recorded)
    newest = max(slots(tmp_path), key=lambda path: path.stat().st_mtime_ns)
    content = newest.read_bytes()
    newest.write_bytes(
        {
            "empty": b"",
            "half": content[: len(content) // 2],
            "flipped": bytes((content[0] ^ 1,)) + content[1:],
            "another version": b'{"version":2} 76a8fb44\n',
        }[cut]
    )
    signing, _ = opened(tmp_path)
    assert [signing.verify(frame) for frame in recorded] == [SignatureVerdict.REPLAYED] * 5


def test_a_slot_cut_or_flipped_anywhere_is_never_taken_for_whole(tmp_path: Path) -> None:
    fly(tmp_path, frames(5))
    newest, older = sorted(slots(tmp_path), key=lambda p: p.stat().st_mtime_ns, reverse=True)
    whole = newest.read_bytes()
    older.unlink()
    broken = [whole[:n] for n in range(len(whole))]
    broken += [whole[:n] + bytes((whole[n] ^ 4,)) + whole[n + 1 :] for n in range(len(whole))]
    for content in broken:
        newest.write_bytes(content)
        with pytest.raises(ConfigError, match="new key"):
            opened(tmp_path)


def test_a_slot_that_is_no_file_is_a_broken_one(tmp_path: Path) -> None:
    (tmp_path / "signing.key.time-0").mkdir()
    with pytest.raises(ConfigError):
        opened(tmp_path)


def test_another_key_begins_again(tmp_path: Path) -> None:
    fly(tmp_path, frames(5))
    signing, _ = opened(tmp_path, SigningKey(bytes(range(2, 34))))
    assert signing.timestamp == NOW
    assert signing.streams == {}


def test_it_is_stored_each_second(tmp_path: Path) -> None:
    signing, store = opened(tmp_path)
    keeper = SigningKeeper(signing, store)
    generation = store._last.generation if store._last else 0
    for tenth in range(100):
        keeper.keep(tenth / 10.0)
    assert store._last is not None
    assert store._last.generation - generation == 9
    keeper.close()


def test_a_folder_that_cannot_be_written_is_reported_at_the_start(tmp_path: Path) -> None:
    signing, store = opened(tmp_path / "missing")
    with pytest.raises(CompanionError, match="cannot be written"):
        SigningKeeper(signing, store)


def test_what_is_stored_does_not_hold_the_key_and_is_for_the_owner(tmp_path: Path) -> None:
    fly(tmp_path, frames(5))
    for path in slots(tmp_path):
        assert path.stat().st_mode & 0o777 == 0o600
        content = path.read_bytes()
        assert KEY.secret not in content
        assert KEY.secret.hex().encode() not in content
