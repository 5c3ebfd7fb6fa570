"""Where the process keeps what must outlive it: checkpoints and locks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path


def state_directory(configured: str | None, environment: Mapping[str, str]) -> Path:
    """The state directory; it need not exist yet.

    Args:
        configured: What the configuration says; None: systemd's StateDirectory, or the XDG base
            directory specification's place (`~/.local/state/companion`).
        environment: Of the process.
    """
    if configured is not None:
        return Path(configured).expanduser()
    of_service = environment.get("STATE_DIRECTORY", "").partition(":")[0]
    if of_service.startswith("/"):
        return Path(of_service)
    base = environment.get("XDG_STATE_HOME", "")
    if base.startswith("/"):
        return Path(base) / "companion"
    home = environment.get("HOME", "")
    return (Path(home) if home.startswith("/") else Path("/tmp")) / ".local/state/companion"
