"""Plays a row of `observed.yaml` against the simulated vehicle, in memory and on invented time."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass

import msgspec

from companion.domain import Autopilot, FlightMode
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.flight_modes import autopilot_of, mode_of
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.incidents import Incident
from sim_link.autopilot.protocols.addressing import LinkSetup
from sim_link.autopilot.scenario import Scenario
from tests.contract.observed_rows import Fields, Row, Sheet, Step
from tests.protocol.memory_link import MemoryHub, MemoryLink

NAN = math.nan
STEP_S = 0.02
RATES_OVER_S = 10.0
LINKS = {
    "onboard": LinkSetup(),
    "station": LinkSetup("station"),
    "narrow": LinkSetup("narrow"),
    "sole": LinkSetup(has_one_peer=True),
}
"""All on one vehicle, by the name that rows call them."""
AXES = {"east": 0, "north": 1, "up": 2}


def message_class(name: str) -> type[Message]:
    """The class of a MAVLink name."""
    found: type[Message] = getattr(mavlink, f"MAVLink_{name.lower()}_message")
    return found


def value_of(value: object) -> object:
    """A number, list or text as it is; the value of a MAVLink constant's name."""
    if isinstance(value, str) and hasattr(mavlink, value):
        return int(getattr(mavlink, value))
    return value


def make_message(name: str, fields: Fields) -> Message:
    """A message; what is not given is 0, empty, or names the vehicle as the target."""
    kind = message_class(name)
    lengths = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
    unknown = fields.keys() - lengths.keys()
    assert not unknown, f"{name} has no {unknown}"
    values = []
    for field, wire_type in zip(kind.fieldnames, kind.fieldtypes, strict=True):
        value = value_of(fields.get(field, 1 if field.startswith("target_") else 0))
        if wire_type == "char" and lengths[field]:
            value = str(value).encode() if field in fields else b""
        elif lengths[field] and not isinstance(value, list):
            value = [0] * lengths[field]
        values.append(value)
    make: Callable[..., Message] = kind
    return make(*values)


def fits(seen: object, wanted: object) -> bool:
    """Return True if a field is as expected."""
    wanted = value_of(wanted)
    if isinstance(wanted, str):
        return re.fullmatch(wanted, str(seen)) is not None
    if isinstance(seen, list):
        return all(fits(each, wanted) for each in seen)
    assert isinstance(seen, int | float)
    if isinstance(wanted, list):
        least, greatest = wanted
        return bool(least <= seen <= greatest)
    assert isinstance(wanted, int | float)
    if math.isnan(wanted):
        return math.isnan(seen)
    return math.isclose(seen, wanted, rel_tol=1e-5, abs_tol=1e-5)


@dataclass
class View:
    """Messages and state that a step compares."""

    client: tuple[str, int]
    of: tuple[int, int]
    mark: int = 0
    """Number of messages that the client had received when the step began."""
    began_s: float = 0.0


class Player:
    """One vehicle, and all who talk with it."""

    def __init__(self, sheet: Sheet, row: Row, flavour: str) -> None:
        autopilot = {"flavour": flavour, "parameters": row.parameters}
        autopilot |= row.scenario.get("autopilot", {})
        scenario = msgspec.convert({**row.scenario, "autopilot": autopilot}, Scenario)
        self._sheet, self._row = sheet, row
        self.sim = SimEndpoint(scenario, 1, links=tuple(LINKS.values()))
        self._hub = MemoryHub(self.sim)
        self._clients: dict[tuple[str, int], MemoryLink] = {}
        self._codecs: dict[tuple[int, int], MavCodec] = {}
        self._reader = MavCodec(255, 190)
        self._heard: dict[tuple[str, int], list[Message]] = {}
        self._stream: Step | None = None
        self._stream_due_s = 0.0

    def play(self) -> None:
        """The state of the row, then its steps."""
        for step in (Step(state=self._row.state), *self._row.steps):
            self._do(step)

    def _do(self, step: Step) -> None:
        for before in self._sheet.states[step.state] if step.state else ():
            self._do(before)
        seen_on = step.seen_on or step.link or self._row.link
        view = View((seen_on, step.client), step.of)
        self._client(view.client)
        view.mark, view.began_s = len(self._heard[view.client]), self._hub.now_s
        if step.incident is not None:
            incident = msgspec.convert(step.incident, Incident)
            self.sim.apply_incident(incident, self._hub.now_s)
        for name, fields in (step.send or {}).items():
            self._send(make_message(name, fields), step)
        if step.command is not None:
            self._send(self._command(step), step)
        if step.stream is not None:
            self._stream, self._stream_due_s = (step if step.stream else None), self._hub.now_s
        self.run(step.wait_s)
        self._check(step, view)

    def _check(self, step: Step, view: View) -> None:
        if step.ack is not None:
            self._check_ack(step, view)
        for name, fields in (step.expect or {}).items():
            found = self._wait_for(name, fields, step, view)
            assert found, f"no {name} with {fields}; {self._closest(view, name)}"
        if step.none is not None:
            self.run(step.within_s)
            for name, fields in step.none.items():
                found = self._find(view, name, fields)
                assert not found, f"came: {found[0]}"
        for name, wanted in (step.times or {}).items():
            count = len(self._find(view, name, {}))
            assert count == wanted, f"{count} of {name}, not {wanted}"
        if step.rates_hz is not None:
            self._check_rates(step.rates_hz, view)
        self._check_vehicle(step)

    def _check_ack(self, step: Step, view: View) -> None:
        number = getattr(mavlink, f"MAV_CMD_{step.command}")
        acks = self._wait_for("COMMAND_ACK", {"command": number}, step, view)
        results = [mavlink.enums["MAV_RESULT"][vars(ack)["result"]].name for ack in acks]
        wanted = [] if step.ack == "none" else [f"MAV_RESULT_{step.ack}"]
        assert results[:1] == wanted, f"{step.command}: {results}, not {wanted}"

    def _check_rates(self, rates_hz: dict[str, float], view: View) -> None:
        view.mark = len(self._heard[view.client])
        self.run(RATES_OVER_S)
        seen = {name: len(self._find(view, name, {})) / RATES_OVER_S for name in rates_hz}
        wrong = {
            name: rate
            for name, rate in seen.items()
            if abs(rate - rates_hz[name]) > 0.05 * rates_hz[name] + 1.0 / RATES_OVER_S
        }
        assert not wrong, f"{wrong}, not {rates_hz}"

    def _check_vehicle(self, step: Step) -> None:
        if step.mode is None and step.armed is None and step.place is None:
            return
        flavour = self.sim.vehicle.flavour
        state = flavour.heartbeat_state(self.sim.vehicle.time_s)
        kind = (mavlink.MAV_TYPE_QUADROTOR, flavour.firmware.autopilot)
        heartbeat = mavlink.MAVLink_heartbeat_message(*kind, *state, 3)
        if step.mode is not None:
            seen = mode_of(heartbeat, autopilot_of(heartbeat) or Autopilot.OTHER)
            assert seen is FlightMode(step.mode), f"in {seen}, not {step.mode}"
        if step.armed is not None:
            is_armed = bool(state.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            assert is_armed is step.armed
        for axis, wanted_m in (step.place or {}).items():
            seen_m = self.sim.vehicle.estimator.local_enu_m[AXES[axis]]
            assert abs(seen_m - wanted_m) <= step.within_m, f"{axis} {seen_m:.2f} m, not {wanted_m}"

    def run(self, duration_s: float) -> None:
        """Let time pass, with the stream and all that arrives."""
        end_s = self._hub.now_s + duration_s
        while self._hub.now_s < end_s - 1e-9:
            if self._stream is not None and self._hub.now_s >= self._stream_due_s - 1e-9:
                self._stream_due_s += 1.0 / self._stream.rate_hz
                for name, fields in (self._stream.stream or {}).items():
                    self._send(make_message(name, fields), self._stream)
            until_s = min(end_s, self._hub.now_s + STEP_S)
            while self._hub.now_s < until_s:
                self._hub.step(until_s)
            self._collect()

    def _wait_for(self, name: str, fields: Fields, step: Step, view: View) -> list[Message]:
        end_s = view.began_s + step.wait_s + step.within_s
        while not (found := self._find(view, name, fields)) and self._hub.now_s < end_s:
            self.run(STEP_S)
        return found

    def _find(self, view: View, name: str, fields: Fields) -> list[Message]:
        kind = message_class(name)
        return [
            message
            for message in self._heard[view.client][view.mark :]
            if isinstance(message, kind)
            and (message.get_srcSystem(), message.get_srcComponent()) == view.of
            and all(fits(getattr(message, field), value) for field, value in fields.items())
        ]

    def _closest(self, view: View, name: str) -> str:
        found = self._find(view, name, {})
        return f"the last one is {found[-1]}" if found else "none at all"

    def _client(self, who: tuple[str, int]) -> MemoryLink:
        if who not in self._clients:
            self._clients[who] = self._hub.connect(list(LINKS).index(who[0]))
            self._heard[who] = []
        return self._clients[who]

    def _send(self, message: Message, step: Step) -> None:
        codec = self._codecs.setdefault(step.sender, MavCodec(*step.sender))
        self._client((step.link or self._row.link, step.client)).send(codec.encode(message))
        self._collect()

    @staticmethod
    def _command(step: Step) -> Message:
        number = getattr(mavlink, f"MAV_CMD_{step.command}")
        values = [*step.params, *[NAN] * (7 - len(step.params))]
        if step.frame is None:
            return mavlink.MAVLink_command_long_message(*step.target, number, 0, *values)
        frame = getattr(mavlink, f"MAV_FRAME_{step.frame}")
        x, y = (0 if math.isnan(value) else round(value) for value in values[4:6])
        p1, p2, p3, p4 = values[:4]
        return mavlink.MAVLink_command_int_message(
            *step.target, frame, number, 0, 0, p1, p2, p3, p4, x, y, values[6]
        )

    def _collect(self) -> None:
        for who, link in self._clients.items():
            while link.inbox:
                data = link.inbox.popleft()
                self._heard[who] += self._reader.decode(data)
