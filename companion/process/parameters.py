"""Parameters that were changed from a ground station outlive the process.

They are kept beside the checkpoints, a file for each vehicle's link, and are taken up at the next
start as far as the configuration's rules allow; what is the same as in the configuration's file is
not kept.
"""

from __future__ import annotations

import logging
from contextlib import suppress
from pathlib import Path

import msgspec

from companion.io.background_replace import BackgroundReplacer
from companion.tuning import Tunables

log = logging.getLogger("companion.run")

MAX_BYTES = 100_000


class ParameterKeeper:
    """Keeps the parameters of one vehicle.

    Args:
        tunables: The parameters; what was kept is taken up at once.
        path: The file; its directory is made when something is kept.
    """

    def __init__(self, tunables: Tunables, path: Path) -> None:
        self._tunables = tunables
        self._path = path
        self._writer: BackgroundReplacer | None = None
        for problem in tunables.restore(self._load()):
            log.warning("%s: %s; going on without", path, problem)
        self._kept = dict(tunables.changed)
        if self._kept:
            words = ", ".join(f"{name} {value:g}" for name, value in self._kept.items())
            log.info("parameters changed by a ground station: %s (%s)", words, path)

    def run(self, now_s: float) -> None:
        """Keep what changed; never waits."""
        del now_s
        if self._tunables.changed == self._kept:
            return
        self._kept = dict(self._tunables.changed)
        if self._writer is None:
            with suppress(OSError):  # the writer tells what is wrong, once
                self._path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = BackgroundReplacer("write parameters")
        content = msgspec.json.format(msgspec.json.encode(self._kept), indent=2) + b"\n"
        self._writer.replace(self._path, content)

    def close(self, timeout_s: float) -> None:
        """Write what waits, for so long at most."""
        if self._writer is not None:
            self._writer.close(timeout_s)

    def _load(self) -> dict[str, float]:
        """What was kept; a file that cannot be read is told and means nothing."""
        try:
            with self._path.open("rb") as file:
                data = file.read(MAX_BYTES)
            return msgspec.json.decode(data, type=dict[str, float])
        except FileNotFoundError:
            return {}
        except OSError as error:
            log.warning("%s: cannot be read (%s)", self._path, error.strerror)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            log.warning("%s: no parameters (%s); going on without", self._path, error)
        return {}
