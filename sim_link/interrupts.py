"""What a Ctrl-C becomes on its way out."""

from __future__ import annotations


def is_interrupt(error: BaseException | None) -> bool:
    """Whether it comes of a Ctrl-C: compiled code turns that into a SystemError of its own."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None
