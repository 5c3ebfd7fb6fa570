"""What every command begins with: a quiet Ctrl-C, and output that may lose its reader.

Theory of operation. `... | head -1` closes the pipe while the command is still at work, perhaps in
flight. What it prints from then on is dropped; it does what it was asked to, and its exit code is
the same as with a reader. That is caught where bytes go to the descriptor, so it holds for print,
argparse, progress bars and the interpreter's last flush alike.
"""

from __future__ import annotations

import io
import signal
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer


class _PipeOutput(io.FileIO):
    """A descriptor that drops what nobody reads any more."""

    def write(self, data: ReadableBuffer, /) -> int:
        """Write what the system takes; how many bytes that were."""
        try:
            return super().write(data)
        except BrokenPipeError:
            return memoryview(data).nbytes


def outlive_readers() -> None:
    """Let standard output and error go on without a reader; other streams in their place stay."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is not None and stream is getattr(sys, f"__{name}__"):
            setattr(sys, name, _without_reader(stream))


def _without_reader(stream: io.TextIOWrapper) -> io.TextIOWrapper:
    """The same output, as lenient as it was about characters."""
    stream.flush()
    return io.TextIOWrapper(
        io.BufferedWriter(_PipeOutput(stream.fileno(), "w", closefd=False)),
        encoding=stream.encoding,
        errors=stream.errors,
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )


def is_interrupt(error: BaseException | None) -> bool:
    """Whether it comes of a Ctrl-C: compiled code turns that into a SystemError of its own."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def main() -> int:
    """Load the command and run it; the exit code is that of `companion.cli.main`.

    Importing takes a fraction of a second; a Ctrl-C in it ends the process as the system does,
    without a traceback. A SIGINT that the parent had ignored (nohup) stays ignored.
    """
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    outlive_readers()
    from companion.cli import main as run

    signal.signal(signal.SIGINT, before)
    return run()
