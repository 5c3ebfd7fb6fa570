"""The installed `companion` command: a quiet Ctrl-C even while the program is still loading."""

from __future__ import annotations

import signal


def main() -> int:
    """Load the command and run it; the exit code is that of `companion.cli.main`.

    Importing takes a fraction of a second; a Ctrl-C in it ends the process as the system does,
    without a traceback. A SIGINT that the parent had ignored (nohup) stays ignored.
    """
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from companion.cli import main as run

    signal.signal(signal.SIGINT, before)
    return run()
