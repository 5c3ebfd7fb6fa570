"""Opens a page in the user's browser, where there is a screen for one."""

from __future__ import annotations

import os
import sys
import threading
import webbrowser
from contextlib import suppress

SCREENS = ("BROWSER", "DISPLAY", "WAYLAND_DISPLAY")
"""One of these is set where a browser can be seen; over SSH and in services none is."""


def open_page(url: str) -> bool:
    """Open a page without blocking the flight; return False if there is no screen."""
    if sys.platform.startswith("linux") and not any(os.environ.get(name) for name in SCREENS):
        return False
    threading.Thread(target=_open, args=(url,), name="browser", daemon=True).start()
    return True


def _open(url: str) -> None:
    with suppress(webbrowser.Error, OSError):
        webbrowser.open(url)
