"""Entry point of every command: quiet Ctrl-C, and output whose reader may disappear.

Theory of operation. `... | head -1` closes the pipe while the command is still at work, perhaps in
flight. Its output from then on is dropped; the command completes, and its exit code is the same as
with a reader. This is handled where bytes go to the descriptor, so it holds for print, argparse,
progress bars and the interpreter's last flush alike. A stream that was closed from the start
(`>&-`) is the same. A full disk is not: the requested output is missing then, and the exit code is
1. Output on standard error never changes the exit code.

Texts of autopilots, radios, files and plugins are printed by many commands. Control characters in
them are escaped where characters become bytes; only the live screen bypasses that, and escapes its
texts itself.
"""

from __future__ import annotations

import errno
import io
import os
import signal
import sys
from typing import TYPE_CHECKING, Any

from companion import kernel_cache
from companion.errors import printable

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer


class OutputLostError(OSError):
    """Raised when standard output goes to a file that cannot grow."""


class _PipeOutput(io.FileIO):
    """A descriptor that drops output without a reader."""

    def write(self, data: ReadableBuffer, /) -> int:
        """Write bytes, and return the number that the system took."""
        try:
            return super().write(data)
        except OSError as error:
            if self.fileno() == 1 and error.errno in FULL:
                raise OutputLostError(error.errno, error.strerror) from None
            return memoryview(data).nbytes


FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class _EscapedOutput(io.TextIOWrapper):
    """Text output with escaped control characters; `unescaped` writes the same buffer verbatim."""

    def __init__(self, buffer: io.BufferedWriter, **settings: Any) -> None:
        super().__init__(buffer, **settings)
        self.unescaped = io.TextIOWrapper(buffer, **{**settings, "write_through": True})

    def write(self, text: str, /) -> int:
        """Write a text; one that begins with a carriage return writes over its line."""
        is_over = text.startswith("\r")
        super().write("\r" + printable(text[1:]) if is_over else printable(text))
        return len(text)


def ignore_broken_pipe(*, escapes: bool = False) -> None:
    """Keep standard streams working without a reader; with `escapes` control codes are escaped."""
    _fill_descriptors()
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is not None and stream is getattr(sys, f"__{name}__"):
            setattr(sys, name, _without_reader(stream, _EscapedOutput if escapes else None))


def _fill_descriptors() -> None:
    """Open the null device for a closed standard stream: else a file would get its number."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest number that is free
        if getattr(sys, name) is None:
            mode = "r" if number == 0 else "w"
            setattr(sys, name, os.fdopen(number, mode, encoding="utf-8", closefd=False))


def _without_reader(
    stream: io.TextIOWrapper, kind: type[io.TextIOWrapper] | None
) -> io.TextIOWrapper:
    """Return the same output, as lenient as it was about characters."""
    stream.flush()
    return (kind or io.TextIOWrapper)(
        io.BufferedWriter(_PipeOutput(stream.fileno(), "w", closefd=False)),
        encoding=stream.encoding,
        errors=stream.errors,
        line_buffering=stream.line_buffering or stream.write_through,  # PYTHONUNBUFFERED
    )


def is_interrupt(error: BaseException | None) -> bool:
    """Return True if a Ctrl-C caused the error, which compiled code turns into a SystemError."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def obey_termination() -> None:
    """Treat SIGTERM as a Ctrl-C, unless the parent process has it ignored."""
    if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, signal.default_int_handler)


def main() -> int:
    """Load the command and run it; the exit code is that of `companion.cli.main`.

    A Ctrl-C while the command is imported ends the process as the system does, without a
    traceback. A SIGINT that the parent had ignored (nohup) stays ignored. SIGTERM is a Ctrl-C from
    then on: it is reported, and files that are being written are removed.
    """
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    ignore_broken_pipe(escapes=True)
    kernel_cache.forgoes_compiler = True
    from companion.cli import main as run

    def obey() -> None:
        signal.signal(signal.SIGINT, before)
        obey_termination()

    try:
        try:
            return run(on_loaded=obey)
        finally:  # also after --help
            sys.stdout.flush()
    except OutputLostError as error:
        sys.stderr.write(f"companion: standard output: {error.strerror}\n")
        sys.stdout = sys.stderr  # which drops the rest silently
        return 1
