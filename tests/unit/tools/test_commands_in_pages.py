"""Commands that pages have for copying are understood, and give no port to two programs."""

from __future__ import annotations

import re
import shlex
from collections import Counter
from pathlib import Path
from textwrap import dedent

import pytest

from companion.arguments import RaisingParser, argument_parser
from companion.config.radios import flown_radios
from companion.config.schema import load_config
from companion.flight_setup import radio_links
from companion.io.links.transports import parse_flight_link, parse_transport
from companion.link.interface import LinkRole
from sim_link.emulators.catalogue import kind_of
from sim_link.lab import radio_follower
from sim_link.lab.radio_outlets import parse_outlet

ROOT = Path(__file__).resolve().parents[3]
PAGES = sorted([ROOT / "README.md", *ROOT.glob("docs/**/*.md")])
BLOCK = re.compile(r"^( *)```\w*\n(.*?)^\1```$", re.DOTALL | re.MULTILINE)
"""In a list it is indented."""
LISTENING = re.compile(r"--(?:connect|ranging|follow|master)[ =]udp(?:in)?:([\w.]+:\d+)")


def blocks_of(page: Path) -> list[list[str]]:
    """The commands of each block, without remarks; a backslash at the end goes on."""
    texts = (dedent(text) for _, text in BLOCK.findall(page.read_text(encoding="utf-8")))
    return [text.replace("\\\n", " ").splitlines() for text in texts]


def commands_of(page: Path) -> list[list[str]]:
    """Every companion and every radio of a page, as words."""
    lines = [line.removesuffix("&") for block in blocks_of(page) for line in block]
    own = [line for line in lines if re.match(r"companion (?:--|radio )|sim-link radio --", line)]
    return [shlex.split(line, comments=True) for line in own]


def in_root(path: Path | None) -> Path | None:
    """A file of this checkout; those that a reader is to make count as none."""
    return ROOT / path if path is not None and (ROOT / path).exists() else None


def test_commands_of_a_list_are_read_too() -> None:
    steps = commands_of(ROOT / "docs" / "radios" / "calibration.md")
    assert [words[2] for words in steps] == ["record", "calibrate", "calibrate", "calibrate"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.name))
def test_companions_and_radios_are_called_as_they_understand_it(page: Path) -> None:
    for words in commands_of(page):
        if words[:2] == ["companion", "radio"]:
            arguments = argument_parser().parse_args(words[1:])
            radios = flown_radios((), getattr(arguments, "radios", []))
            assert len(radio_links(radios)) == len(radios)
        elif words[0] == "companion":
            arguments = argument_parser().parse_args(words[1:])
            for url in (arguments.connect, *arguments.ranging, *arguments.gcs):
                assert parse_flight_link(url, LinkRole.VEHICLE)
            radios = flown_radios(
                load_config(in_root(arguments.fly_config)).radios, arguments.radio
            )
            assert len(radio_links(radios)) == len(radios)
        else:
            parser = RaisingParser()
            radio_follower.add_arguments(parser)
            arguments = parser.parse_args(words[2:])
            assert parse_transport(arguments.follow)
            if arguments.radio is None:
                assert parse_transport(f"udpout:{arguments.send_to}")
            else:
                assert parse_outlet(arguments.to, kind_of(arguments.radio))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.name))
def test_no_two_programs_of_a_block_listen_on_one_port(page: Path) -> None:
    for block in blocks_of(page):
        if any("sim-link radio" in line or "mavproxy.py" in line for line in block):
            ports = Counter(port for line in block for port in LISTENING.findall(line))
            assert not [port for port, count in ports.items() if count > 1]
