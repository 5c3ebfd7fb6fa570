"""The `companion` command, which ends orderly when its standard input closes.

So even after a kill -9 of its parent no companion continues to fly a vehicle.
"""

from __future__ import annotations

import os
import signal
import sys
import threading

from companion.entry import main


def _end_with_input() -> None:
    while os.read(sys.stdin.fileno(), 4096):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    threading.Thread(target=_end_with_input, daemon=True).start()
    sys.exit(main())
