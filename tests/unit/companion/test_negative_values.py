"""Values that begin with a minus, as southern and western positions do."""

from __future__ import annotations

import pytest

from companion.arguments import RaisingParser, argument_parser
from sim_link.cli import subcommand_parser


@pytest.mark.parametrize("position", ["-35.36,149.16", "-33.4,-70.6,520", "-.5,-60.1"])
def test_a_southern_place_can_be_typed(position: str) -> None:
    radio = [
        "radio",
        "--follow",
        "tcp:127.0.0.1:5760",
        "--emitter",
        position,
        "--emitter",
        position,
    ]
    assert subcommand_parser().parse_args(radio).emitter == [position, position]
    calibrate = ["radio", "calibrate", "--point", position]
    assert argument_parser().parse_args(calibrate).point == position


def test_an_unknown_option_is_still_one() -> None:
    parser = RaisingParser()
    parser.add_argument("--position")
    with pytest.raises(Exception, match="expected one argument"):
        parser.parse_args(["--position", "-x"])
