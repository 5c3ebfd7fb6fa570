"""A radio unplugged in flight and plugged in again, by its own bytes and in invented time."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from companion.config.schema import CompanionConfig
from companion.flight_setup import build_endpoint
from companion.guidance.phases import Phase
from companion.link.endpoint import CompanionEndpoint
from companion.link.interface import Journal, LinkRole, LinkSpec
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.emulators.catalogue import make_emulator
from tests.loop.emulated_radio import EmulatedRadio
from tests.loop.loop_helpers import Loop
from tests.radio_flights import as_flown, setup_name, setup_of, sigmas
from tests.radio_formats import FORMAT_OF

SEED = 1
GONE_S = 15.0


class Unplugged(EmulatedRadio):
    """While it is gone nothing comes, but once the word that its line is lost."""

    is_gone = is_end_reported = False

    def __call__(self, sim: SimEndpoint, now_s: float) -> bytes | None:
        printed = super().__call__(sim, now_s)
        was_reported, self.is_end_reported = self.is_end_reported, self.is_gone
        if self.is_gone:
            return None if was_reported else b""
        return printed


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kraken", pytest.param("iw_ftm", marks=pytest.mark.slow)])
def test_it_is_held_for_while_it_is_gone_and_flown_on_by_itself(name: str) -> None:
    format_ = as_flown(FORMAT_OF[name])
    setup = setup_of(setup_name(format_))
    scenario = setup.scenario
    link = format_.setup(scenario.emitter.emitter_id, **sigmas(format_, scenario))

    def make(
        config: CompanionConfig, journal: Journal, links: Sequence[LinkSpec]
    ) -> CompanionEndpoint:
        return build_endpoint(config, journal, (*links[:-1], LinkSpec(LinkRole.RANGING, link)))

    radio = Unplugged(scenario, SEED, make_emulator(name, SEED))
    loop = Loop(setup.config, scenario, SEED, None, radio, 1.0 / scenario.payload.rate_hz, make)
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 60.0)
    radio.is_gone = True
    loop.run(GONE_S)
    assert loop.phase is Phase.HOLD
    texts = [text for _, text in loop.notes.texts]
    assert sum("hold: no ranging" in text for text in texts) == 1
    assert texts.count(f"radio {name}: silent for 5 s") == 1
    assert f"radio {name}: heard again" not in texts
    radio.is_gone = False
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 20.0)
    loop.run(5.0)
    texts = [text for _, text in loop.notes.texts]
    assert texts.count(f"radio {name}: silent for 5 s") == 1
    assert texts.count(f"radio {name}: heard again") == 1
