"""The installed `companion` command: a quiet Ctrl-C even while the program is still loading."""

from __future__ import annotations

import signal


def main() -> int:
    """Load the command and run it.

    Importing takes a fraction of a second; a Ctrl-C in it ends the process as the system does,
    without a traceback. A SIGINT that the parent had ignored (nohup) stays ignored.

    Returns:
        The exit code, see `companion.cli.main`.
    """
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from companion.cli import main as run

    signal.signal(signal.SIGINT, before)
    return run()
