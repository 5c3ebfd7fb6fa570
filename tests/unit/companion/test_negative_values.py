"""Values that begin with a minus, as southern and western places do."""

from __future__ import annotations

import pytest

from companion.arguments import RaisingParser, argument_parser
from sim_link.cli import subcommand_parser


@pytest.mark.parametrize("place", ["-35.36,149.16", "-33.4,-70.6,520", "-.5,-60.1"])
def test_a_southern_place_can_be_typed(place: str) -> None:
    radio = ["radio", "--follow", "tcp:127.0.0.1:5760", "--emitter", place, "--emitter", place]
    assert subcommand_parser().parse_args(radio).emitter == [place, place]
    calibrate = ["radio", "calibrate", "--point", place]
    assert argument_parser().parse_args(calibrate).point == place


def test_an_unknown_option_is_still_one() -> None:
    parser = RaisingParser()
    parser.add_argument("--place")
    with pytest.raises(Exception, match="expected one argument"):
        parser.parse_args(["--place", "-x"])
