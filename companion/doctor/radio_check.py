"""The doctor on the radios: listens to each as a flight would, and reports faults."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from companion.config.radios import RadioConfig, radio_setup
from companion.doctor.findings import CheckResult, RadioFacts, fail, ok, warn
from companion.errors import CompanionError
from companion.io.links.radio_lines import radio_link
from companion.io.shell import Clock, Shell
from companion.link.intake import FloodBudget
from companion.link.quality import RadioStatus, RadioWatch
from companion.link.radio_stage import RadioSetup, RadioStage
from companion.mav.endpoint import Chunk, OneShotEndpoint

MANY_REFUSED = 0.2
"""Share of the messages."""
LATE_S = 0.5
BESIDE = "emitter 1 m from the antenna: companion radio calibrate --beside 1"
CALIBRATE = "companion radio calibrate, with the emitter at a known place"


class RadioProbe(OneShotEndpoint):
    """Listens to one radio for a while, and sends nothing but the link's greeting."""

    def __init__(self, setup: RadioSetup, duration_s: float) -> None:
        super().__init__(duration_s)
        self.stage = RadioStage(setup)
        self.watch = RadioWatch(self.stage)
        self._budget = FloodBudget()

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Process received bytes."""
        super().receive(chunk, now_s)
        if self._budget.spend_raw(len(chunk.data)):
            self.stage.receive(chunk.data, now_s)

    def handle_timer(self, now_s: float) -> None:
        """Advance the rates."""
        super().handle_timer(now_s)
        self._budget.renew()
        self.watch.tick(now_s)


def inspect_radios(radios: Sequence[RadioConfig], duration_s: float) -> tuple[RadioFacts, ...]:
    """Listen to each radio for a while, one after the other."""
    return tuple(_inspect(radio, duration_s) for radio in radios)


def _inspect(radio: RadioConfig, duration_s: float) -> RadioFacts:
    url = radio.url or ""
    try:
        setup = radio_setup(radio, f"radio {radio.name}")
        probe = RadioProbe(setup, duration_s)
        Shell(probe, [radio_link(setup, url).transport], Clock()).run_blocking()
    except CompanionError as error:
        return RadioFacts(radio.name, url, str(error))
    uncalibrated = []
    if "range" in setup.kind.gives and not (
        "range_offset_m" in radio.settings or "offset_steps" in radio.options
    ):
        uncalibrated.append("ranges")
    gives_bearing = "bearing" in setup.kind.gives or "azimuth" in setup.kind.gives
    if gives_bearing and not {"bearing_sign", "bearing_mount_deg"} & radio.settings.keys():
        uncalibrated.append("bearings")
    return RadioFacts(
        radio.name,
        url,
        status=probe.watch.status(probe.now_s),
        bytes=probe.stage.received,
        needs_offset=setup.is_uncalibrated,
        has_clock=probe.stage.clock.is_heard,
        uncalibrated=tuple(uncalibrated),
    )


def check_radios(radios: Sequence[RadioFacts]) -> Iterator[CheckResult]:
    """Check rate, time and calibration of each radio."""
    for radio in radios:
        subject = f"radio {radio.name}"
        if radio.problem is not None or radio.status is None:
            text = radio.problem or "not looked at"
            yield fail(subject, text, "correct its name, address or settings")
            continue
        yield _check_rate(subject, radio, radio.status)
        if radio.status.measured:
            yield _check_time(subject, radio, radio.status)
        if radio.needs_offset:
            text = "uncalibrated: range offset unknown, so nothing will be localised"
            yield fail(subject, text, f"{BESIDE} --radio {radio.name}@{radio.url}")
        elif radio.uncalibrated:
            text = f"{' and '.join(radio.uncalibrated)} are not calibrated"
            yield warn(subject, text, CALIBRATE)
        else:
            yield ok(subject, "calibration is set")


def _check_rate(subject: str, radio: RadioFacts, status: RadioStatus) -> CheckResult:
    refused = sum(status.refused.values())
    reasons = ", ".join(f"{reason} {count}" for reason, count in status.refused.items())
    if status.silent_s is None:
        text = f"nothing heard at {radio.url}"
        return warn(subject, text, "check power, cable, speed and port; is an emitter on?")
    if not status.measured:
        said = "; ".join(part for part in (reasons, status.unrecognised) if part)
        text = f"{radio.bytes} bytes, nothing measured ({said or 'nothing was understood'})"
        return warn(subject, text, "is it the right name, is an emitter on? companion radio watch")
    text = f"{status.rate_hz:.1f} Hz, {refused} refused{f': {reasons}' if reasons else ''}"
    text += f"; {status.unrecognised}" if status.unrecognised else ""
    if refused > MANY_REFUSED * (refused + status.measured):
        return warn(subject, text, "look at its settings; companion radio watch shows it live")
    return ok(subject, text)


def _check_time(subject: str, radio: RadioFacts, status: RadioStatus) -> CheckResult:
    if not radio.has_clock:
        return ok(subject, "no clock of its own: arrival less lag_s is the time of measurement")
    text = f"its own clock, heard {1e3 * (status.age_s or 0.0):.0f} ms late"
    if status.restarts:
        return warn(subject, f"{text}; it restarted {status.restarts} times", "check its power")
    if (status.age_s or 0.0) > LATE_S:
        return warn(subject, text, "use a faster line, or poll more often")
    return ok(subject, text)
