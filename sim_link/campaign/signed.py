"""Signed flights: a key on both sides, and a companion that remembers across restarts."""

from __future__ import annotations

from companion.config.schema import CompanionConfig
from companion.flight_setup import build_endpoint
from companion.link.endpoint import CompanionEndpoint
from companion.link.recorders import Journal
from companion.mav.signing import ONE_LINK_EACH, LinkSigning, Signing, SigningKey, timestamp_at
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.scenario import Scenario

KEY = SigningKey(bytes(range(100, 132)))
STARTED_UNIX_S = 1.795e9
STATION_LINK = 200


class SignedPair:
    """Makes the two ends of a signed link, and makes them anew."""

    def __init__(self) -> None:
        started = timestamp_at(STARTED_UNIX_S)
        self._companion = Signing(KEY, started, rules=ONE_LINK_EACH)
        self._vehicle = Signing(KEY, started)
        self.station = LinkSigning(Signing(KEY, started), STATION_LINK)

    def companion(self, config: CompanionConfig, journal: Journal, links: int) -> CompanionEndpoint:
        """A companion that remembers what the one before stored at its end."""
        before = self._companion
        self._companion = Signing(KEY, before.timestamp, dict(before.streams), ONE_LINK_EACH)
        return build_endpoint(
            config, journal, links, signing=self._companion, started_unix_s=STARTED_UNIX_S
        )

    def simulator(self, scenario: Scenario, seed: int, now_s: float) -> SimEndpoint:
        """A vehicle that goes on from its newest timestamp."""
        self._vehicle = Signing(KEY, self._vehicle.timestamp)
        return SimEndpoint(
            scenario, seed, now_s, signing=self._vehicle, started_unix_s=STARTED_UNIX_S + now_s
        )
