from __future__ import annotations

from pathlib import Path

import pytest

from companion.errors import ConfigError
from companion.io.state_directory import load_signing_key, store_signing_key
from companion.mav.signing import SigningKey

DIGITS = "0123456789abcdef" * 4


def key_file(folder: Path, text: str, mode: int = 0o600) -> Path:
    path = folder / "signing.key"
    path.write_text(text)
    path.chmod(mode)
    return path


def test_a_key_is_sixty_four_digits(tmp_path: Path) -> None:
    assert load_signing_key(key_file(tmp_path, DIGITS + "\n")).secret.hex() == DIGITS


@pytest.mark.parametrize("mode", [0o644, 0o640, 0o604, 0o620, 0o700])
def test_a_key_that_others_may_read_is_refused(tmp_path: Path, mode: int) -> None:
    with pytest.raises(ConfigError, match="chmod 600"):
        load_signing_key(key_file(tmp_path, DIGITS, mode))


@pytest.mark.parametrize("text", ["", "abc", DIGITS + "00", "x" * 64, "0" * 64, "\xff" * 64])
def test_what_is_no_key_is_refused_and_not_quoted(tmp_path: Path, text: str) -> None:
    path = key_file(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        load_signing_key(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
    assert not text or text not in str(caught.value).removeprefix(str(path))


def test_a_missing_key_tells_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="token_hex"):
        load_signing_key(tmp_path / "none")


@pytest.mark.parametrize("is_there_before", [False, True])
def test_a_stored_key_is_read_again_and_is_its_owners_alone(
    tmp_path: Path, is_there_before: bool
) -> None:
    path = tmp_path / "signing.key"
    if is_there_before:
        key_file(tmp_path, DIGITS)
    store_signing_key(path, SigningKey(bytes(range(32))))
    assert path.stat().st_mode & 0o777 == 0o600
    assert load_signing_key(path).secret == bytes(range(32))
    assert [each.name for each in tmp_path.iterdir()] == ["signing.key"]
