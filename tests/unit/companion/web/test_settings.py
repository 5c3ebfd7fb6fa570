"""The options of the page, as people type them."""

from pathlib import Path

import pytest

from companion.errors import ConfigError
from companion.web.settings import web_settings


def test_a_port_alone_serves_this_computer_only_and_needs_no_token() -> None:
    settings = web_settings("8080")
    assert (settings.host, settings.port, settings.token) == ("127.0.0.1", 8080, None)
    assert settings.url == "http://127.0.0.1:8080/"


def test_beyond_loopback_a_token_is_made_up_and_shown_in_the_address() -> None:
    settings, other = web_settings("0.0.0.0:8080"), web_settings("0.0.0.0:8080")
    assert settings.token is not None
    assert len(settings.token) >= 16
    assert settings.token != other.token
    assert settings.url == f"http://0.0.0.0:8080/?token={settings.token}"


def test_an_ipv6_address_keeps_its_brackets() -> None:
    assert web_settings("[::1]:8080").url == "http://[::1]:8080/"


@pytest.mark.parametrize("address", ["", "x", "0", "65536", "127.0.0.1", "8080:", ":-1", "1e3"])
def test_a_bad_address_is_refused(address: str) -> None:
    with pytest.raises(ConfigError, match="--web"):
        web_settings(address)


def test_a_short_token_is_refused() -> None:
    with pytest.raises(ConfigError, match="at least 8"):
        web_settings("8080", token="1234567")


def test_tiles_must_be_a_folder_with_tiles(tmp_path: Path) -> None:
    for folder, why in (
        (tmp_path / "nowhere", "No such file or directory"),
        (tmp_path, "contains no tiles"),
    ):
        with pytest.raises(ConfigError, match=why) as caught:
            web_settings("8080", tiles=folder)
        assert str(caught.value).startswith(f"--web-tiles {folder}: ")
        assert "\n" not in str(caught.value)
    picture = tmp_path / "15" / "3" / "4.png"
    picture.parent.mkdir(parents=True)
    picture.touch()
    assert web_settings("8080", tiles=tmp_path).tiles == tmp_path
    with pytest.raises(ConfigError, match="Not a directory"):
        web_settings("8080", tiles=picture)
