"""All emulators, by the name under which `sim-link radio --as` knows them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from companion.errors import ConfigError
from sim_link.emulators import bearings, nlink, power, printed_lines, uwb_binary, uwb_text, wifi
from sim_link.emulators.emulator import Emulator

MODULES = (
    bearings,
    nlink,
    power,
    printed_lines,
    uwb_binary,
    uwb_text,
    wifi,
)
OWN_STREAM = 45_010
"""Seed offset that keeps a radio's invented values apart from its measurement noise."""
EMULATORS: dict[str, type[Emulator]] = {
    kind.name: kind
    for module in MODULES
    for kind in vars(module).values()
    if isinstance(kind, type) and issubclass(kind, Emulator) and "name" in vars(kind)
}


def kind_of(name: str) -> type[Emulator]:
    """Return the emulator of a name; the `ConfigError` for an unknown one lists all."""
    kind = EMULATORS.get(name)
    if kind is None:
        known = ", ".join(sorted(EMULATORS))
        raise ConfigError(f"--as {name}: no such radio; known are {known}")
    return kind


def check_emitters(kind: type[Emulator], emitter_ids: Sequence[int]) -> None:
    """Raise `ConfigError` for emitters that a format cannot name or has no room for."""
    for emitter_id in emitter_ids:
        if emitter_id not in kind.ids:
            last = kind.ids[-1]
            raise ConfigError(f"--as {kind.name}: it names emitters 0 to {last}, not {emitter_id}")
    if len(emitter_ids) > kind.most:
        said = f"it has room for {kind.most} emitters, not for {len(emitter_ids)}"
        raise ConfigError(f"--as {kind.name}: {said}")


def make_emulator(name: str, seed: int, clock_s: float | None = None) -> Emulator:
    """Return an emulator; its clock is drawn below one hour if not given."""
    rng = np.random.default_rng((seed, OWN_STREAM))
    drawn_s = float(rng.uniform(10.0, 3600.0))
    return kind_of(name)(drawn_s if clock_s is None else clock_s, rng)
