"""The demo opens the map in the reader's browser, and only where there is a screen."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from companion.demo.runner import SCREENS

OPEN = "from companion.demo.runner import open_page; import time; "
URL = "http://127.0.0.1:8080/?token=abc"


def environment(**more: str) -> dict[str, str]:
    bare = {name: value for name, value in os.environ.items() if name not in SCREENS}
    return {**bare, **more}


def test_the_page_is_opened_by_the_readers_own_browser(tmp_path: Path) -> None:
    browser, opened = tmp_path / "browser", tmp_path / "opened"
    browser.write_text(f'#!/bin/sh\necho "$1" > {opened}.new && mv {opened}.new {opened}\n')
    browser.chmod(0o755)
    code = f"{OPEN} assert open_page({URL!r}); time.sleep(2.0)"
    with subprocess.Popen([sys.executable, "-c", code], env=environment(BROWSER=str(browser))):
        give_up_s = time.monotonic() + 30.0
        while not opened.exists():
            assert time.monotonic() < give_up_s
            time.sleep(0.05)
    assert opened.read_text() == f"{URL}\n"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere there is a screen")
def test_without_a_screen_nothing_is_opened_that_would_take_the_terminal() -> None:
    code = f"{OPEN} assert not open_page({URL!r})"
    assert subprocess.run([sys.executable, "-c", code], env=environment()).returncode == 0
