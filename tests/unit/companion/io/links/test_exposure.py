from __future__ import annotations

import pytest

from companion.errors import ConfigError
from companion.io.links.transports import check_exposure, parse_flight_link
from companion.link.interface import LinkRole

OWN, OPEN, SERIAL = "udp:127.0.0.1:14540", "udp:0.0.0.0:14540", "serial:/dev/ttyAMA0"


def check(*links: str, has_key: bool = False, unsigned_ranging: bool = False) -> None:
    roles = [LinkRole.VEHICLE, *[LinkRole.RANGING] * (len(links) - 1)]
    given = [parse_flight_link(link, role) for link, role in zip(links, roles, strict=True)]
    check_exposure(given, has_key=has_key, unsigned_ranging=unsigned_ranging)


def test_links_of_this_machine_need_no_key() -> None:
    check(OWN, "tcpin::5760", SERIAL, "udpout:10.0.0.2:14580")


@pytest.mark.parametrize("links", [(OPEN,), (SERIAL, OPEN), ("tcpin:10.0.0.3:5760",)])
def test_a_link_that_others_reach_is_refused_without_a_key(links: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError, match="--signing-key FILE, or insist with --insecure"):
        check(*links)
    check(*links, has_key=True)


def test_unsigned_ranging_is_for_links_that_no_other_system_reaches() -> None:
    check(OPEN, OWN, has_key=True, unsigned_ranging=True)
    with pytest.raises(ConfigError, match=r"udpin:0\.0\.0\.0:14540"):
        check(OWN, OPEN, has_key=True, unsigned_ranging=True)


def test_unsigned_ranging_leaves_the_ground_stations_links_signed() -> None:
    station = parse_flight_link(OPEN, LinkRole.GCS)
    check_exposure([station], has_key=True, unsigned_ranging=True)
