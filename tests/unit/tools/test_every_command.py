"""Every command that a page has for copying is understood by the program that it calls."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from textwrap import dedent

import pytest

from companion.arguments import argument_parser
from companion.cli import check_order_of_options
from sim_link.cli import simulator_parser, subcommand_parser
from sim_link.lab.conformance.cli import parsed_arguments
from tests.unit.tools.test_commands_in_pages import PAGES, ROOT

SHELL = re.compile(r"^( *)```sh\n(.*?)^\1```$", re.DOTALL | re.MULTILINE)
TARGETS = set(
    re.findall(r"^([a-z-]+)(?: [a-z-]+)*:", (ROOT / "Makefile").read_text(), re.MULTILINE)
)
TARGETS |= {"venv-demo", "venv-dev", "venv-package"}
OF_OTHERS = {
    "pytest",
    ".",
    "apt",
    "systemctl",
    "debootstrap",
    "packaging/try_fresh.sh",
    "packaging/try_in_root.sh",
    "ssh",
    "scp",
    "raspi-config",
    "usermod",
    "prlimit",
    "reboot",
    "journalctl",
} | set(
    ("mavproxy.py", "sim_vehicle.py", "commander", "mode", "arm", "pip", "pipx", "python3", "echo")
)
"""Programs that this project does not have; their commands are read, and never run, by a test."""
PX4S_TARGET = "px4_sitl"
THEIR_MODULES = {"pytest", "companion", "pip", "http.server"}


def commands_of(page: Path) -> list[list[str]]:
    """The lines of a page's shell blocks as words, without what a shell adds around them."""
    texts = (dedent(text) for _, text in SHELL.findall(page.read_text(encoding="utf-8")))
    lines = [line for text in texts for line in text.replace("\\\n", " ").splitlines()]
    found = []
    for line in lines:
        words = shlex.split(line.removesuffix("&"), comments=True)
        while words and re.fullmatch(r"[A-Z_]+=\S*|sudo", words[0]):
            words = words[1:]
        for mark in (">", "|", ";"):
            words = words[: words.index(mark)] if mark in words else words
        if words and not words[0].startswith("("):
            found.append([words[0].removeprefix(".venv/bin/"), *words[1:]])
    return found


def understand(words: list[str]) -> None:
    """Give a command to its own parser; raises what that raises."""
    program, *rest = words
    match program:
        case "companion":
            check_order_of_options(argument_parser().parse_args(rest))
        case "sim-link" if rest and not rest[0].startswith("-"):
            subcommand_parser().parse_args(rest)
        case "sim-link":
            simulator_parser().parse_args(rest)
        case "companion-conformance":
            parsed_arguments(rest)
        case "make":
            targets = [word for word in rest if "=" not in word]
            assert PX4S_TARGET in targets or set(targets) <= TARGETS
        case "python" if rest[0] == "-m":
            assert rest[1] in THEIR_MODULES
        case "python":
            assert (ROOT / rest[0]).exists() or rest[0] == "test_companion_acme.py"
        case "dask":
            assert rest[0] in ("scheduler", "worker")
        case _:
            assert program in OF_OTHERS, f"`{program}`: whose is it?"


@pytest.mark.parametrize(("page", "commands"), [("index", 2), ("px4", 6)])
def test_a_newcomer_needs_two_commands_to_the_demo_and_six_to_a_flight_on_px4(
    page: str, commands: int
) -> None:
    text = (ROOT / f"docs/{page}.md").read_text(encoding="utf-8")
    (_, first), *_ = SHELL.findall(text)
    assert len(first.splitlines()) == commands
    assert first.startswith("make venv-demo"), "from a checkout, and nothing else"


@pytest.mark.parametrize(
    "page", [*PAGES, ROOT / "CONTRIBUTING.md"], ids=lambda page: str(page.relative_to(ROOT))
)
def test_commands_for_copying_are_understood(page: Path) -> None:
    for words in commands_of(page):
        try:
            understand(words)
        except (Exception, SystemExit) as error:
            pytest.fail(f"{shlex.join(words)}: {error}")


def test_a_command_that_is_not_understood_is_found() -> None:
    for text in ("companion demo --sped 4", "sim-link --sed 7", "make dmo", "gadget --on"):
        with pytest.raises(Exception, match=r"\w"):
            understand(shlex.split(text))


def test_a_newcomer_needs_two_commands_and_a_flight_on_px4_six() -> None:
    first = SHELL.findall((ROOT / "docs/index.md").read_text(encoding="utf-8"))[0][1]
    px4 = SHELL.findall((ROOT / "docs/px4.md").read_text(encoding="utf-8"))[0][1]
    assert len(first.splitlines()) == 2
    assert len(px4.splitlines()) == 6
