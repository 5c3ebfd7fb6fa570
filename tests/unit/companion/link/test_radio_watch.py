"""Texts and records of radios: silence once, refusals rarely, and never beyond a budget."""

from __future__ import annotations

from dataclasses import replace

from companion.config.radios import RadioConfig
from companion.config.schema import CompanionConfig
from companion.flight_setup import FlightFacts, build_endpoint
from companion.link.intake import MAX_RAW_BYTES, RAW_BYTES, FloodBudget
from companion.link.interface import RadioSettings, RadioSetup
from companion.link.quality import RadioWatch
from companion.link.radio_stage import RadioStage
from companion.link.text_gate import TextGate
from companion.mav.endpoint import Chunk
from companion.view.snapshot import picture_of
from tests.unit.companion.link.test_radio_stage import KIND, READING, measured
from tests.unit.companion.link.wire import Wire

SETTINGS = RadioSettings(timeout_s=3.0)


def watch_of(settings: RadioSettings = SETTINGS) -> RadioWatch:
    return RadioWatch(RadioStage(RadioSetup(KIND, settings)))


def announced(watch: RadioWatch, from_s: float, to_s: float) -> list[str]:
    """Return the texts announced between two times, at twenty ticks a second."""
    ticks = range(round(20 * from_s), round(20 * to_s))
    return [news.text for tick in ticks for news in watch.tick(0.05 * tick)]


def test_silence_is_reported_once_and_its_end_once() -> None:
    watch = watch_of()
    assert announced(watch, 0.0, 60.0) == ["radio said: silent for 3 s"]
    measured(watch.stage, READING, now_s=60.0)
    assert announced(watch, 60.0, 62.0) == ["radio said: heard again"]
    assert announced(watch, 62.0, 90.0) == ["radio said: silent for 3 s"]


def test_the_last_text_says_if_a_radio_that_comes_and_goes_is_heard() -> None:
    watch, gate = watch_of(), TextGate(6000.0)
    texts: list[str] = []
    for tick in range(800):
        now_s = 0.05 * tick
        if 3.5 <= now_s < 5.0:
            measured(watch.stage, READING, now_s=now_s)
        admitted = [news for news in watch.tick(now_s) if gate.admit(news, now_s)]
        texts += [news.text for news in [*admitted, *gate.due(now_s)]]
    silent = "radio said: silent for 3 s"
    assert texts == [silent, "radio said: heard again", silent]


def test_a_radio_that_may_be_silent_is_not_announced_as_silent() -> None:
    assert announced(watch_of(RadioSettings(timeout_s=0.0)), 0.0, 60.0) == []


def test_a_new_name_is_reported() -> None:
    watch = watch_of()
    measured(watch.stage, replace(READING, emitter="tag"), now_s=0.0)
    (text,) = announced(watch, 0.0, 1.0)
    assert text.startswith("radio said: emitter `tag` has the id ")


def test_many_refusals_are_reported_with_their_reasons_and_rarely() -> None:
    watch = watch_of(RadioSettings(range_max_m=10.0))
    texts = []
    for second in range(40):
        for _ in range(10):
            measured(watch.stage, READING, now_s=float(second))
        texts += announced(watch, second, second + 1.0)
    assert len(texts) == 2
    assert texts[0] == "radio said: 10 readings were refused: range above range_max_m (10)"


def test_few_refusals_are_not_reported() -> None:
    watch = watch_of(RadioSettings(range_max_m=100.0, rate_max_hz=None))
    for number in range(200):
        far = replace(READING, range_m=500.0 if number % 10 == 0 else 50.0)
        measured(watch.stage, far, now_s=0.01 * number)
    assert announced(watch, 2.0, 3.0) == []


def test_the_rate_is_that_of_the_last_seconds() -> None:
    watch = watch_of()
    for tick in range(200):
        now_s = 0.05 * tick
        if tick % 2 == 0:
            measured(watch.stage, replace(READING, range_m=1.0 + tick), now_s=now_s)
        watch.tick(now_s)
    assert 9.0 <= watch.status(10.0).rate_hz <= 11.0
    assert watch.status(10.0).text == "10 measurements/s"
    assert watch.status(15.0).text.endswith("silent for 5 s")


def test_a_link_has_so_many_bytes_a_tick_and_more_after_a_pause() -> None:
    budget = FloodBudget()
    assert budget.spend_raw(MAX_RAW_BYTES)
    assert not budget.spend_raw(1)
    budget.renew()
    assert budget.spend_raw(RAW_BYTES)
    assert not budget.spend_raw(1)
    for _ in range(100):
        budget.renew()
    assert not budget.spend_raw(MAX_RAW_BYTES + 1)
    assert budget.spend_raw(MAX_RAW_BYTES)
    assert budget.dropped_unread == 3


def test_the_endpoint_tells_of_a_flood_and_of_silence_and_shows_its_radios() -> None:
    config = CompanionConfig(radios=(RadioConfig(name="ndjson", url="x"),))
    facts = FlightFacts(started_unix_s=0.0, config=config, links=2)
    wire = Wire()
    wire.endpoint = build_endpoint(config, wire.journal, facts.link_specs())
    wire.ready()
    for _ in range(20):
        wire.endpoint.receive(Chunk(1, b"x" * 4096, is_datagram=False), wire.now_s)
    wire.wait(20.0)
    assert any(text.startswith("flood: ") for text in wire.journal.texts)
    assert wire.journal.texts.count("radio ndjson: silent for 5 s") == 1
    radios = picture_of(wire.endpoint, wire.now_s)["radios"]
    assert isinstance(radios, tuple)
    assert radios[0][0] == "ndjson"
    assert "silent for" in radios[0][1]
    records = [fields for kind, fields in wire.journal.records if kind == "radio"]
    assert records[-1]["bytes"] == MAX_RAW_BYTES
