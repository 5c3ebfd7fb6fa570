"""Access to the page and its buttons."""

import pytest

from companion.web.settings import Access, is_loopback

TOKEN = "correct-horse"
HERE, ELSEWHERE = "127.0.0.1", "192.168.1.7"


@pytest.mark.parametrize("host", ["127.0.0.1", "127.9.9.9", "localhost", "::1", "[::1]"])
def test_loopback_addresses_are_known(host: str) -> None:
    assert is_loopback(host)


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.7", "::", "example.org", ""])
def test_others_are_not_loopback(host: str) -> None:
    assert not is_loopback(host)


def test_on_loopback_all_may_look_and_none_may_press_unless_control_is_on() -> None:
    access = Access(HERE, None)
    assert access.may_view(HERE, None)
    assert not access.may_control(HERE, None)
    assert Access(HERE, None, is_control_on=True).may_control(HERE, None)


def test_beyond_loopback_nothing_goes_without_the_token() -> None:
    access = Access("0.0.0.0", TOKEN, is_control_on=True)
    for given in (None, "", "wrong", TOKEN[:-1], TOKEN + "x"):
        assert not access.may_view(ELSEWHERE, given)
        assert not access.may_control(ELSEWHERE, given)
    assert access.may_view(ELSEWHERE, TOKEN)
    assert access.may_control(ELSEWHERE, TOKEN)


def test_a_client_on_this_computer_needs_the_token_too_where_the_network_is_served() -> None:
    # Behind a reverse proxy or a tunnel everybody looks like this computer.
    assert not Access("0.0.0.0", TOKEN).may_view(HERE, None)


def test_an_open_view_gives_no_control() -> None:
    access = Access("0.0.0.0", TOKEN, is_control_on=True, is_view_open=True)
    assert access.may_view(ELSEWHERE, None)
    assert not access.may_control(ELSEWHERE, None)


def test_control_without_a_token_never_leaves_this_computer() -> None:
    access = Access("0.0.0.0", None, is_control_on=True, is_view_open=True)
    assert not access.may_control(ELSEWHERE, None)
    assert not access.may_control(ELSEWHERE, "")


@pytest.mark.parametrize(
    ("header", "ours"),
    [
        ("127.0.0.1:8080", True),
        ("localhost:8080", True),
        ("[::1]:8080", True),
        ("evil.example:8080", False),
        ("127.0.0.1.evil.example", False),
        ("", False),
        ("[::1", False),
    ],
)
def test_a_foreign_host_name_is_refused_on_loopback(header: str, ours: bool) -> None:
    assert Access(HERE, None).is_host_ours(header) is ours


def test_a_socket_from_another_site_is_refused() -> None:
    access = Access(HERE, None)
    assert access.is_origin_ours("http://127.0.0.1:8080", "127.0.0.1:8080")
    assert access.is_origin_ours(None, "127.0.0.1:8080")
    assert not access.is_origin_ours("http://evil.example", "127.0.0.1:8080")
    assert not access.is_origin_ours("null", "127.0.0.1:8080")
    assert not access.is_origin_ours("http://[::1", "127.0.0.1:8080")
