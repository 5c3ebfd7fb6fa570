"""`companion radio calibrate --beside`: the range offset, with the emitter at the antenna.

The reported range at a known short distance, less that distance, is the radio's constant: the delay
of an SDR, of cables and of boards. It is kept for this one radio.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import replace

import msgspec

from companion.config.schema import load_config, with_radios
from companion.errors import ConfigError
from companion.flight_setup import radio_links
from companion.io.links.transports import check_exposure
from companion.io.shell import Clock, Shell
from companion.io.state.radio_offsets import KeptOffset, keep_offset, radio_key
from companion.io.state.vehicle_lock import state_directory
from companion.link.radio_stage import RadioSetup, RadioStage
from companion.mav.endpoint import Chunk, OneShotEndpoint

LISTEN_S = 20.0
FEWEST = 5
"""Least ranges for a median; a cell has one for each attach of the phone."""
MOST_BESIDE_M = 20.0
"""Farther away a reflection may be in the median: that is a line test."""
SIGMA_OF_MAD = 1.4826


class _Listener(OneShotEndpoint):
    """Collects the uncorrected ranges of a radio."""

    def __init__(self, setup: RadioSetup, end_s: float) -> None:
        super().__init__(end_s)
        self.stage = RadioStage(setup)
        self.ranges_m: list[float] = []

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Decode received bytes."""
        super().receive(chunk, now_s)
        found = self.stage.receive(chunk.data, now_s)
        self.ranges_m += [m.range_m for m in found if m.range_m is not None]


def run(
    arguments: argparse.Namespace, neutral: Callable[[RadioSetup], RadioSetup]
) -> tuple[int, str]:
    """Collect ranges and keep the offset.

    Return the exit code, 1 for too few ranges, and the report.
    """
    distance_m = arguments.beside
    if not 0.0 <= distance_m <= MOST_BESIDE_M:
        raise ConfigError(f"--beside {distance_m:g}: give metres from 0 to {MOST_BESIDE_M:g}")
    config = with_radios(load_config(arguments.config), arguments.radios)
    if len(config.radios) != 1:
        raise ConfigError("--beside: name one radio, --radio NAME@URL")
    (link,), (radio,) = radio_links(config.radios), config.radios
    if not arguments.is_insecure:
        check_exposure([link], has_key=False)
    setup = link.spec.radio
    assert setup is not None
    plain = neutral(setup)
    every = msgspec.structs.replace(plain.settings, rate_max_hz=None)
    listener = _Listener(replace(plain, settings=every), arguments.seconds or LISTEN_S)
    Shell(listener, [link.transport], Clock()).run_blocking()
    ranges_m = listener.ranges_m
    if len(ranges_m) < FEWEST:
        refused = listener.stage.all_refused.most_common(2)
        reasons = ", ".join(f"{reason} {count}" for reason, count in refused)
        return 1, (
            f"{len(ranges_m)} ranges, {FEWEST} are needed ({reasons or 'none refused'}; "
            f"{listener.stage.unrecognised or 'all recognised'}); try --seconds 60"
        )
    middle_m = statistics.median(ranges_m)
    scatter_m = SIGMA_OF_MAD * statistics.median(abs(each - middle_m) for each in ranges_m)
    offset = KeptOffset(
        range_offset_m=round(middle_m - distance_m, 3),
        scatter_m=round(scatter_m, 3),
        ranges=len(ranges_m),
        unix_s=round(time.time(), 0),
    )
    key = radio_key(radio.name, radio.url or "")
    directory = state_directory(config.process.state_directory, os.environ)
    path = keep_offset(directory, key, offset)
    return 0, (
        f"{key}: range offset {offset.range_offset_m:+.2f} m "
        f"(median of {offset.ranges}, scatter {offset.scatter_m:.2f} m); kept in {path}\n"
        f"settings:\n  range_offset_m: {offset.range_offset_m}"
    )
