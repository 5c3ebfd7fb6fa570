"""The plugin of docs/radios/plugin.md, installed as its reader would, and tried by its own test."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "radios" / "plugin.md"
FILES = ("pyproject.toml", "companion_acme.py", "test_companion_acme.py")


def files_of(page: str) -> dict[str, str]:
    """The blocks of code that are files, in the page's order."""
    blocks = re.findall(r"^```(?:toml|python)\n(.*?)^```$", page, re.M | re.S)
    return dict(zip(FILES, blocks, strict=True))


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A Python command that finds what was installed into the folder's `site`."""
    environment = {**os.environ, "PYTHONPATH": str(folder / "site")}
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=120.0,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package of the page, installed next to this environment."""
    folder = tmp_path_factory.mktemp("acme")
    for name, text in files_of(PAGE.read_text()).items():
        (folder / name).write_text(text)
    options = ("--no-index", "--no-deps", "--no-build-isolation", "--quiet", "--target", "site")
    installed = run(folder, "-m", "pip", "install", *options, ".")
    assert installed.returncode == 0, installed.stderr
    return folder


def test_the_radio_of_the_page_is_listed_with_its_package(folder: Path) -> None:
    listed = run(folder, "-m", "companion", "radio", "list")
    last = listed.stdout.splitlines()[-1]
    assert last.startswith("acme ")
    assert last.endswith("Acme Pinger (from companion-acme)")


def test_its_options_are_checked_like_any_others(folder: Path) -> None:
    watched = run(folder, "-m", "companion", "radio", "watch", "acme:least_snr=6@/dev/null")
    assert watched.returncode == 2
    assert "least_snr" in watched.stderr


def test_the_test_of_the_page_passes_and_its_golden_file_has_what_was_strong_enough(
    folder: Path,
) -> None:
    assert run(folder, "test_companion_acme.py").returncode == 0
    golden = (folder / "acme.jsonl").read_text().splitlines()
    assert [line[:34] for line in golden] == [
        '{"emitter":"7F21","range_m":12.34,',
        '{"emitter":"7F22","range_m":10.21,',
    ]
    tested = run(folder, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_companion_acme.py")
    assert "1 passed" in tested.stdout, tested.stdout


def test_a_broken_one_is_named_and_ends_the_program_with_2(folder: Path) -> None:
    module = folder / "companion_acme.py"  # where a program is run comes first on its path
    whole = module.read_text()
    module.write_text("import no_such_module\n")
    try:
        url = "acme@udp:127.0.0.1:50987"
        flown = run(folder, "-m", "companion", "radio", "watch", url)
        listed = run(folder, "-m", "companion", "radio", "list")
    finally:
        module.write_text(whole)
    assert flown.returncode == 2
    assert flown.stderr.count("\n") == 1
    assert "radio acme: the plugin companion-acme (companion_acme:ACME)" in flown.stderr
    assert "No module named 'no_such_module'" in flown.stderr
    assert "broken: radio acme: the plugin companion-acme" in listed.stdout
