"""What a probe needs of a link: send bytes, and wait for bytes until a time of the link."""

from __future__ import annotations

from typing import Protocol


class ProbeLink(Protocol):
    """One client's connection to the peer under test.

    Its time is the peer's own, in seconds: invented in memory, the wall clock on a real link.
    """

    @property
    def now_s(self) -> float:
        """The time of the link."""

    @property
    def is_datagram(self) -> bool:
        """Whether one `send` arrives as one piece."""

    def send(self, data: bytes) -> None:
        """Send bytes as one piece."""

    def poll(self, until_s: float) -> list[bytes]:
        """Let time pass until something arrives, at the latest until `until_s`.

        Returns:
            What arrived, in order; empty when `until_s` is reached.
        """

    def another(self) -> ProbeLink | None:
        """A second client of the same peer; None where the link has room for one only."""
