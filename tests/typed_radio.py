"""`companion radio watch` in memory: what a radio prints, and what is shown of it."""

from __future__ import annotations

from companion.config.radios import flown_radios, radio_setups
from companion.domain import RangingMeasurement
from companion.link.quality import RadioWatch
from companion.mav.endpoint import Chunk
from companion.radio_tools.radio_commands import WatchingEndpoint


class Typed:
    """`companion radio watch RADIO` with what the radio prints."""

    def __init__(self, radio: str, printed: str) -> None:
        setups = radio_setups(flown_radios((), [radio]))
        shown: list[list[str]] = []
        endpoint = WatchingEndpoint(setups, [radio], shown.append, 1.0)
        endpoint.receive(Chunk(0, printed.encode(), is_datagram=False), 0.5)
        endpoint.handle_timer(1.0)
        self.stage = endpoint.stages[0]
        self.lines = shown[-1]
        self.words = RadioWatch(self.stage).status(1.0).text

    @property
    def newest(self) -> dict[int, RangingMeasurement]:
        return self.stage.newest

    @property
    def ranges_m(self) -> list[float]:
        return [m.range_m for _, m in sorted(self.newest.items()) if m.range_m is not None]

    @property
    def head(self) -> str:
        return next(line for line in self.lines if "Hz" in line)
