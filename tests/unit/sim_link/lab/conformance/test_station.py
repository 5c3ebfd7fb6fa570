from __future__ import annotations

from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from sim_link.lab.conformance.station import ProbeLink, Station


class Stream:
    """A byte stream on which everything arrives at once, cut anywhere."""

    is_datagram = False

    def __init__(self, pieces: list[bytes]) -> None:
        self.now_s = 0.0
        self._pieces = pieces

    def send(self, data: bytes) -> None:
        """No receiver hears it."""

    def poll(self, until_s: float) -> list[bytes]:
        self.now_s = until_s
        pieces, self._pieces = self._pieces, []
        return pieces

    def another(self) -> ProbeLink | None:
        return None

    def close_others(self) -> None:
        """There are none."""


def test_frames_of_a_byte_stream_are_distinguished_however_it_is_cut() -> None:
    codec = MavCodec(1, 1)
    frames = [codec.encode(mavlink.MAVLink_timesync_message(0, 4_711 + i)) for i in range(3)]
    together = b"".join(frames)
    station = Station(Stream([together[:30], together[30:]]), kind=None)
    station.run(0.1)
    assert station.frames_since(0) == frames
    assert len(station.inbox) == 3


class Echo(Stream):
    """Sends back what it hears."""

    def __init__(self) -> None:
        super().__init__([])

    def send(self, data: bytes) -> None:
        self._pieces.append(data)


def test_answers_are_looked_for_behind_what_was_sent_last_whatever_is_repeated() -> None:
    station = Station(Echo(), kind=mavlink.MAV_TYPE_GCS)
    station.run(0.5)
    station.send(mavlink.MAVLink_timesync_message(0, 1))
    station.run(3.0)
    heard = [entry.message.get_type() for entry in station.inbox[station.asked :]]
    assert heard == ["TIMESYNC", "HEARTBEAT", "HEARTBEAT", "HEARTBEAT"]


def test_what_comes_while_one_listens() -> None:
    station = Station(Echo(), kind=mavlink.MAV_TYPE_GCS)
    station.run(0.5)
    assert len(station.listen(2.0)) == 2
