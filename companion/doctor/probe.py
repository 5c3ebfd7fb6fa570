"""The doctor on the wire: it listens and sends requests, without lasting changes.

Theory of operation. It sends under the companion's ids (its component of the vehicle's system),
requests the streams that a flight needs, with the flight's own requester, and lets them settle
before it counts them. It also requests parameters, the time, the fence, and messages that are sent
only on request. The only commands it sends are SET_MESSAGE_INTERVAL and REQUEST_MESSAGE, which a
restart of the autopilot undoes: no arming, no mode, no setpoint, no parameter is ever set.

Radios are listened to as in a flight.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import TypeVar

from companion.config.radios import RadioConfig, radio_setup
from companion.doctor.autopilot_settings import needed_parameters
from companion.doctor.findings import (
    AutopilotFacts,
    CheckResult,
    LinkFacts,
    RadioFacts,
    StreamRate,
    fail,
    ok,
    warn,
)
from companion.errors import CompanionError
from companion.geometry.coordinates import LocalOrigin
from companion.guidance.events import AutopilotFenceRead
from companion.guidance.vehicle import mode_name
from companion.io.links.transports import radio_link
from companion.io.shell import Clock, Shell
from companion.link import outbound
from companion.link.autopilot_fence import (
    FenceDownload,
    ParameterRequests,
    hears_transmitter,
    value_of,
)
from companion.link.autopilot_queries import STREAM_INTERVAL_S, StreamFreshness, StreamRequester
from companion.link.binding import AutopilotBinding
from companion.link.conversion.clock_sync import ClockSync
from companion.link.inbound import origin_of
from companion.link.intake import Authenticity, FloodBudget
from companion.link.interface import RadioSetup
from companion.link.outlet import COMPONENT_ID
from companion.link.quality import RadioStatus, RadioWatch, SequenceMonitor
from companion.link.radio_stage import RadioStage
from companion.mav.codec import MavCodec, sender_of
from companion.mav.dialect import MAVLink_ekf_status_report_message, Message, mavlink
from companion.mav.endpoint import Chunk, OneShotEndpoint
from companion.mav.flight_modes import autopilot_of, class_of, mode_of, other_mode_name
from companion.mav.payloads import name_of

HEARTBEAT_PERIOD_S = 1.0
TIMEOUT_S = 10.0
"""Longest wait for an autopilot."""
SETTLE_S = 2.5
"""Time from the first frame until streams have the requested rates."""
PARAMETER_RETRY_S = 0.7
PARAMETER_TRIES = 4
HEARTBEAT_HZ = 1.0
M = TypeVar("M", bound=Message)
NAMES = {number: mavlink.mavlink_map[number].msgname for number in STREAM_INTERVAL_S}


class DoctorProbe(OneShotEndpoint):
    """Examines one link; without a system id it takes the first autopilot heard."""

    def __init__(
        self,
        name: str,
        system_id: int | None,
        authenticity: Authenticity,
        duration_s: float,
        component_id: int | None = None,
    ) -> None:
        super().__init__(None)
        self._name = name
        self._count_s = duration_s
        self._authenticity = authenticity
        self._binding = AutopilotBinding(system_id, is_keyed=authenticity.is_on)
        signing = authenticity.of_link(0)
        own = (system_id or 1, component_id or COMPONENT_ID)
        self._codec = MavCodec(*own, signing, keeps_unknown=True)
        self._freshness = StreamFreshness()
        self._streams = StreamRequester(self._freshness)
        self._clock = ClockSync()
        self._sequence = SequenceMonitor()
        self._names: tuple[str, ...] = ()
        """Parameters that the autopilot is asked for."""
        self._parameters = ParameterRequests(PARAMETER_RETRY_S, PARAMETER_TRIES)
        self._fence_fetch = FenceDownload()
        self._fence: AutopilotFenceRead | None = None
        self._counts: Counter[str] = Counter()
        self._newest: dict[str, Message] = {}
        self._autopilots: set[int] = set()
        self._companions: set[int] = set()
        self._bytes = 0
        self._bound_s: float | None = None
        self._began_s: float | None = None
        self._next_heartbeat_s = 0.0

    # The Endpoint protocol

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Process received bytes."""
        super().receive(chunk, now_s)
        self._authenticity.advance(now_s)
        self._bytes += len(chunk.data)
        for message in self._codec.decode(chunk.data, is_datagram=chunk.is_datagram):
            if self._authenticity.is_proved(bytes(message.get_msgbuf())):
                self._receive_message(message, chunk, now_s)
        unknown, ids = self._codec.splitter.take_unknown(), self._binding.bound
        if ids is not None and chunk.peer == self._binding.peer:
            self._sequence.exclude(sum(sender_of(frame) == ids.ids for frame in unknown))

    def handle_timer(self, now_s: float) -> None:
        """Send requests that are due."""
        super().handle_timer(now_s)
        self._authenticity.advance(now_s)
        if self._began_s is None:
            self._began_s = now_s
        if now_s >= self._next_heartbeat_s:
            self._next_heartbeat_s = now_s + HEARTBEAT_PERIOD_S
            self._send(outbound.heartbeat())
        system_id, component_id = self._binding.system_id, self._binding.component_id
        if system_id is None:
            return
        for question in (
            self._streams.due(now_s, (system_id, component_id), self._binding.autopilot),
            self._clock.due(now_s, system_id, component_id),
            self._parameters.due(self._names, now_s, (system_id, component_id)),
            self._fence_fetch.due(now_s, (system_id, component_id), is_wanted=self._fence is None),
        ):
            if question is not None:
                self._send(question)
        self._fence = self._fence or self._fence_fetch.check_silence(now_s)

    @property
    def is_finished(self) -> bool:
        """True if all requests are answered and rates counted, or no autopilot was heard."""
        if self._is_stopped:
            return True
        if self._bound_s is None:
            return self._began_s is not None and self.now_s - self._began_s > TIMEOUT_S
        is_counted = self.now_s - self._bound_s >= SETTLE_S + self._count_s
        is_answered = not any(map(self._parameters.is_open, self._names))
        return is_counted and is_answered and self._fence is not None

    # What was found

    def facts(self) -> LinkFacts:
        """Return the facts so far."""
        return LinkFacts(
            name=self._name,
            waited_s=self.now_s - (self._began_s or 0.0),
            autopilot=None if self._binding.system_id is None else self._autopilot_facts(),
            other_autopilots=tuple(sorted(self._autopilots - {self._binding.system_id})),
            other_companions=tuple(sorted(self._companions)),
            non_autopilots=tuple(self._binding.candidates.non_autopilot_names()),
            bytes_received=self._bytes,
            bad_frames=self._codec.counters.bad_crc + self._codec.undecodable,
            unproved_frames=self._codec.unproved,
        )

    def _autopilot_facts(self) -> AutopilotFacts:
        binding, newest = self._binding, self._newest
        heartbeat = newest["HEARTBEAT"]
        assert isinstance(heartbeat, mavlink.MAVLink_heartbeat_message)
        mode = mode_of(heartbeat, binding.autopilot)
        other = other_mode_name(heartbeat, binding.autopilot)
        fix = self._newest_of(mavlink.MAVLink_gps_raw_int_message)
        state = self._newest_of(mavlink.MAVLink_extended_sys_state_message)
        is_undefined = state is None or state.landed_state == mavlink.MAV_LANDED_STATE_UNDEFINED
        empty = {"EXTENDED_SYS_STATE": is_undefined, "GPS_GLOBAL_ORIGIN": self._origin() is None}
        px4 = self._newest_of(mavlink.MAVLink_estimator_status_message)
        status = px4 or self._newest_of(MAVLink_ekf_status_report_message)
        return AutopilotFacts(
            autopilot=binding.autopilot,
            vehicle_class=class_of(heartbeat),
            system_id=binding.system_id or 0,
            component_id=binding.component_id,
            mode=mode_name(mode, binding.autopilot, other),
            is_armed=bool(heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED),
            rates=self._rates(),
            parameters={name: self._parameters.values.get(name) for name in self._names},
            has_rc=self._has_rc(),
            heard=frozenset(newest) - {name for name, is_empty in empty.items() if is_empty},
            origin=self._origin(),
            estimator_flags=None if status is None else int(status.flags),
            gps_fix=None if fix is None else fix.fix_type,
            battery_pct=self._battery_pct(),
            round_trip_s=self._clock.round_trip_s,
            clock_offset_s=self._clock.offset_at_s(self.now_s),
            loss=self._sequence.loss(self.now_s),
            fence=self._fence,
        )

    def _rates(self) -> tuple[StreamRate, ...]:
        begin_s = (self._bound_s or 0.0) + SETTLE_S
        seconds = max(0.0, self.now_s - begin_s)
        asked = {"HEARTBEAT": HEARTBEAT_HZ}
        asked |= {NAMES[number]: 1.0 / interval for number, interval in STREAM_INTERVAL_S.items()}
        return tuple(
            StreamRate(name, hertz, self._counts[name], seconds) for name, hertz in asked.items()
        )

    def _newest_of(self, kind: type[M]) -> M | None:
        message = self._newest.get(kind.msgname)
        return message if isinstance(message, kind) else None

    def _origin(self) -> LocalOrigin | None:
        message = self._newest_of(mavlink.MAVLink_gps_global_origin_message)
        return None if message is None else origin_of(message, self._binding.autopilot)

    def _has_rc(self) -> bool | None:
        status = self._newest_of(mavlink.MAVLink_sys_status_message)
        return None if status is None else hears_transmitter(status)

    def _battery_pct(self) -> int | None:
        status = self._newest_of(mavlink.MAVLink_sys_status_message)
        return None if status is None or status.battery_remaining < 0 else status.battery_remaining

    # In and out

    def _receive_message(self, message: Message, chunk: Chunk, now_s: float) -> None:
        sender = (message.get_srcSystem(), message.get_srcComponent())
        if isinstance(message, mavlink.MAVLink_heartbeat_message):
            if autopilot_of(message) is not None:
                self._autopilots.add(sender[0])
            elif sender[1] == self._codec.component_id:
                self._companions.add(sender[0])
        if not self._binding.recognise(message, chunk.peer, now_s):
            return
        if self._bound_s is None:
            self._begin(now_s)
        self._sequence.take(message.get_seq(), now_s)
        self._freshness.receive(message, now_s)
        self._clock.receive(message, now_s)
        own = (self._codec.system_id, self._codec.component_id)
        self._fence = self._fence_fetch.receive(message, now_s, own) or self._fence
        name = message.get_type()
        self._newest[name] = message
        if self._bound_s is not None and now_s >= self._bound_s + SETTLE_S:
            self._counts[name] += 1
        if isinstance(message, mavlink.MAVLink_param_value_message):
            parameter, value = name_of(message), value_of(message, self._binding.autopilot)
            if parameter in self._names and value is not None:
                self._parameters.values[parameter] = value

    def _begin(self, now_s: float) -> None:
        self._bound_s = now_s
        self._codec.system_id = self._binding.system_id or 1
        self._names = needed_parameters(self._binding.autopilot)

    def _send(self, message: Message) -> None:
        data = self._codec.encode(message)
        self._output.append(Chunk(0, data, self._binding.peer))


MANY_REFUSED = 0.2
"""Share of refused messages above which they are a finding."""
LATE_S = 0.5
BESIDE = "emitter 1 m from the antenna: companion radio calibrate --beside 1"
CALIBRATE = "companion radio calibrate, with the emitter at a known position"


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
        Shell(probe, [radio_link(setup, url).transport], Clock()).run_whole()
    except CompanionError as error:
        return RadioFacts(radio.name, url, str(error))
    uncalibrated = []
    if "range" in setup.kind.gives and not radio.has_range_offset:
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
            text = radio.problem or "not checked"
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
        return warn(subject, text, "check its settings; companion radio watch shows it live")
    return ok(subject, text)


def _check_time(subject: str, radio: RadioFacts, status: RadioStatus) -> CheckResult:
    if not radio.has_clock:
        return ok(subject, "no clock of its own: measurement time is arrival minus lag_s")
    text = f"its own clock, received {1e3 * (status.age_s or 0.0):.0f} ms late"
    if status.restarts:
        return warn(subject, f"{text}; it restarted {status.restarts} times", "check its power")
    if (status.age_s or 0.0) > LATE_S:
        return warn(subject, text, "use a faster line, or poll more often")
    return ok(subject, text)
