"""Keys of signing, and their setting up over a link."""

from __future__ import annotations

import pytest

from companion.errors import ConfigError
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.signing import (
    SigningKey,
    is_secret,
    setup_from,
)
from tests.unit.companion.mav.signing_helpers import KEY, NOW, SECRET, unsigned


def setup_message(system: int = 1, component: int = 1, secret: bytes = SECRET) -> Message:
    message = mavlink.MAVLink_setup_signing_message(system, component, list(secret), NOW)
    (decoded,) = MavCodec(1, 1).decode(MavCodec(255, 190).encode(message))
    return decoded


def test_a_key_is_taken_over_a_trusted_link() -> None:
    setup = setup_from(setup_message(), 1, 1, is_trusted_link=True)
    assert setup is not None
    assert (setup.key, setup.initial_timestamp) == (KEY, NOW)


def test_a_key_of_zeros_ends_signing() -> None:
    setup = setup_from(setup_message(secret=bytes(32)), 1, 1, is_trusted_link=True)
    assert setup is not None
    assert (setup.key, setup.initial_timestamp) == (None, 0)


@pytest.mark.parametrize(("system", "component"), [(0, 0), (1, 0), (0, 1), (2, 1), (1, 191)])
def test_a_key_that_was_broadcast_or_is_for_another_is_ignored(system: int, component: int) -> None:
    assert setup_from(setup_message(system, component), 1, 1, is_trusted_link=True) is None


def test_a_key_over_an_open_link_is_ignored() -> None:
    assert setup_from(setup_message(), 1, 1, is_trusted_link=False) is None


def test_only_setup_signing_is_secret() -> None:
    assert is_secret(MavCodec(255, 190).encode(setup_message()))
    assert not is_secret(unsigned())


def test_a_key_does_not_show_itself() -> None:
    assert SECRET.hex() not in repr(KEY) + str(KEY)
    assert repr(SECRET) not in repr(KEY)


@pytest.mark.parametrize("secret", [b"", bytes(31), bytes(33), bytes(32)])
def test_a_key_of_a_wrong_length_or_of_zeros_is_refused(secret: bytes) -> None:
    with pytest.raises(ConfigError):
        SigningKey(secret)
