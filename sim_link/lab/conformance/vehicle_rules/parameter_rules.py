"""Parameters: listed, read, set, echoed; encoded as the flavour does; never created."""

from __future__ import annotations

import math
import struct

from sim_link.lab.conformance import mavlink_oracle as mav
from sim_link.lab.conformance.mavlink_oracle import INT32, NAN, REAL32
from sim_link.lab.conformance.protocol_clients import ANSWER_S, ParameterClient
from sim_link.lab.conformance.rules import ARDUPILOT, CHANGES, FLIES, PX4, RuleBook, assume, require

SERVICE = "MAVLink guide, Parameter Protocol"
STRICT = f"{SERVICE} (stricter than real autopilots)"
ERRORS = "MAVLink common, PARAM_ERROR; MAVSDK 4.1 reports it"
NOBODYS = "NO_SUCH_PARAM"


class ParameterRules(ParameterClient):
    """Parameters: listed, read, set, echoed; encoded as the flavour does; never created."""

    book = RuleBook("parameters")

    @book.rule(SERVICE)
    def list_is_complete(self) -> None:
        """PARAM_REQUEST_LIST sends every index from 0 to count - 1, and one constant count."""
        found = self.read_all()
        counts = {p.count for p in found}
        require(counts == {len(found)}, f"counts {sorted(counts)}, {len(found)} parameters")
        indices = [p.index for p in found]
        require(indices == list(range(len(found))), "indices are not 0 to count - 1")
        require(len({p.name for p in found}) == len(found), "a name comes twice")

    @book.rule(f"{SERVICE} (streams are paced)")
    def list_is_paced(self) -> None:
        """The list is not sent in one burst, and the heartbeat continues."""
        found = self.read_all()
        moments = len(set(self.times(mav.ParamValue, self.asked)))
        assume(len(found) >= 20, "too few parameters to judge")
        require(moments > 3, f"{len(found)} parameters in {moments} moments")

    @book.rule(SERVICE)
    def names_fit(self) -> None:
        """Names have 1 to 16 characters of A to Z, 0 to 9 and underscore."""
        for found in self.read_all():
            good = 1 <= len(found.name) <= 16 and found.name.replace("_", "A").isalnum()
            require(good, f"`{found.name}`")

    @book.rule(f"{SERVICE}; {mav.OBSERVED_BOTH}")
    def types_are_the_flavours(self) -> None:
        """Only the types occur that the flavour has."""
        allowed = {INT32, REAL32} if self.is_px4 else {2, 4, INT32, REAL32}
        kinds = {p.kind for p in self.read_all()}
        require(kinds <= allowed, f"types {sorted(kinds)}")

    @book.rule(SERVICE)
    def values_are_finite(self) -> None:
        """Every value of type REAL32 is a number."""
        for found in self.read_all():
            is_good = found.kind != REAL32 or math.isfinite(found.value)
            require(is_good, f"{found.name} is not finite")

    @book.rule("PX4 and ArduPilot parameter references; MAVSDK and ground stations ask for these")
    def needed_parameters_exist(self) -> None:
        """The parameters that clients ask for by name are there."""
        for name in self.notes.parameters:
            self.read(name)

    @book.rule(SERVICE)
    def read_by_index_and_by_name_agree(self) -> None:
        """A parameter read by index is the same as by name."""
        for listed in self.read_all()[::7][:10]:
            self.request_read("", listed.index)
            by_index, by_name = self.await_value(listed.name), self.read(listed.name)
            same = (by_index.raw, by_index.kind) == (by_name.raw, by_name.kind)
            require(same and by_index.count == listed.count, f"{listed.name} differs")

    @book.rule(f"{SERVICE} (16 characters without a NUL)")
    def longest_names_are_found(self) -> None:
        """A name of 16 characters, sent without a NUL, is found."""
        names = [p.name for p in self.read_all() if len(p.name) == 16]
        assume(bool(names), "no parameter has a name of 16 characters")
        self.read(names[0])

    @book.rule(SERVICE, effect=CHANGES)
    def set_is_echoed_and_kept(self) -> None:
        """PARAM_SET is answered by PARAM_VALUE with the new value, and a read shows it."""
        for name, value in ((self.float_name, 4.25), (self.integer_name, 1.0)):
            before = self.remember(name)
            echoed = self.change(name, value)
            require(echoed.value == value, f"{name}: echo {echoed.value}")
            require(echoed.kind == before.kind, f"{name}: type {echoed.kind}")
            require(self.read(name).value == value, f"{name} was not kept")

    @book.rule(SERVICE, effect=CHANGES)
    def set_of_an_equal_value_is_echoed(self) -> None:
        """PARAM_SET with the current value is echoed, too."""
        before = self.read(self.float_name)
        self.write(before.name, before.value, before.kind)
        require(self.await_value(before.name).raw == before.raw, "another value")

    def _require_encoded(self, kinds: tuple[int, ...], value: float, wanted: bytes) -> None:
        """An integer of one of the types must be sent as certain bytes."""
        name = self.integer_name
        before = self.remember(name)
        require(before.kind in kinds, f"{name} has type {before.kind}")
        value_sent = self.change(name, value)
        require(value_sent.raw == wanted, f"{value:g} is sent as {value_sent.raw.hex()}")

    @book.rule(f"{SERVICE} (bytewise encoding)", effect=CHANGES, flavours=PX4)
    def integers_are_encoded_bytewise(self) -> None:
        """An INT32 travels as its four bytes in the float field."""
        self._require_encoded((INT32,), 3.0, b"\x03\x00\x00\x00")

    @book.rule(f"{SERVICE} (bytewise encoding)", effect=CHANGES, flavours=PX4)
    def negative_integers_survive(self) -> None:
        """A negative INT32, whose bytes are a NaN, survives set, echo and read."""
        negative = [p for p in self.read_all() if p.kind == INT32 and p.value < 0.0]
        assume(bool(negative), "no INT32 parameter is negative")
        chosen = self.remember(negative[0].name)
        body = chosen.raw + bytes(self.target) + chosen.name.encode().ljust(16, b"\0") + b"\x06"
        self.send_payload(mav.ParamSet, body)
        require(self.await_value(chosen.name).raw == chosen.raw, f"{chosen.name} changed")

    @book.rule(
        f"{SERVICE} (C-cast encoding); {mav.OBSERVED_ARDUPILOT}", effect=CHANGES, flavours=ARDUPILOT
    )
    def integers_are_cast_to_float(self) -> None:
        """An integer travels as the float of the same value."""
        self._require_encoded((2, 4, INT32), 1.0, struct.pack("<f", 1.0))

    def _require_unknown(self, what: str) -> None:
        """PARAM_ERROR must follow (ArduPilot may be silent), and no PARAM_VALUE."""
        mark = self.asked
        has_error = self.run_until(lambda: bool(self.heard(mav.ParamError, mark)), ANSWER_S)
        require(not self.values_since(mark), f"{what}: a value is sent")
        require(has_error or not self.is_px4, f"{what}: no PARAM_ERROR")
        self.read(self.float_name)

    @book.rule(ERRORS)
    def unknown_name_is_an_error(self) -> None:
        """Reading a name that does not exist is answered by PARAM_ERROR."""
        self.request_read(NOBODYS)
        self._require_unknown("read by name")

    @book.rule(ERRORS)
    def unknown_index_is_an_error(self) -> None:
        """Reading an index that does not exist is answered by PARAM_ERROR."""
        for index in (30_000, 32_767):
            self.request_read("", index)
            self._require_unknown(f"index {index}")

    @book.rule(SERVICE, effect=CHANGES)
    def set_never_creates_a_parameter(self) -> None:
        """Setting a name that does not exist creates nothing and is answered by PARAM_ERROR."""
        count = self.read(self.float_name).count
        self.write(NOBODYS, 1.0, REAL32)
        self._require_unknown("set")
        require(self.read(self.float_name).count == count, "there is one more")

    def _require_kept(self, name: str, wait_s: float, *values: float) -> None:
        """A parameter must keep its value when others, of type REAL32, are set."""
        before = self.read(name)
        for value in values:
            self.write(name, value, REAL32)
            self.run(wait_s)
            require(self.read(name).raw == before.raw, f"{name}: {value} was stored")

    @book.rule(STRICT, effect=CHANGES, harms=True)
    def nan_is_refused(self) -> None:
        """NaN and infinity are not stored."""
        self._require_kept(self.float_name, 0.3, NAN, math.inf, -math.inf)

    @book.rule(STRICT, effect=CHANGES, harms=True)
    def refused_value_is_answered_by_the_old_one(self) -> None:
        """PARAM_SET of a value that is not stored is answered by a PARAM_VALUE of the old one."""
        before = self.read(self.float_name)
        self.write(before.name, NAN, REAL32)
        mark = self.asked
        self.run(ANSWER_S)
        answers = self.values_since(mark, before.name)
        require(bool(answers) or not self.is_px4, "not answered")
        require(all(each.raw == before.raw for each in answers), "another value is sent")
        require(self.read(before.name).raw == before.raw, "it was stored")

    @book.rule(f"{SERVICE}; {mav.OBSERVED_PX4}", effect=CHANGES, flavours=PX4)
    def wrong_type_is_refused(self) -> None:
        """A value of another type is not stored."""
        self._require_kept(self.integer_name, 0.5, 1.5)

    @book.rule(STRICT, effect=CHANGES, flavours=PX4, harms=True)
    def value_out_of_range_is_refused(self) -> None:
        """A value outside the parameter's range is not stored."""
        self._require_kept("COM_OF_LOSS_T", 0.5, -5.0)

    @book.rule("MAVLink guide, Routing", effect=CHANGES)
    def other_systems_parameters_are_left_alone(self) -> None:
        """PARAM_SET and PARAM_REQUEST_READ for another system are ignored."""
        before = self.read(self.float_name)
        self.write(before.name, before.value + 1.0, REAL32, (77, 1))
        mark = self.asked
        self.send(mav.ParamRead(77, 1, before.name.encode(), -1))
        self.run(1.0)
        require(not self.values_since(mark, before.name), "answered")
        require(self.read(before.name).raw == before.raw, "stored")

    @book.rule(SERVICE)
    def broadcast_read_is_answered(self) -> None:
        """A read for component 0 is answered."""
        self.send(mav.ParamRead(self.target[0], 0, self.float_name.encode(), -1))
        self.await_value(self.float_name)

    @book.rule(SERVICE, effect=FLIES, flavours=PX4)
    def changed_takeoff_altitude_is_flown(self) -> None:
        """A take-off without altitude climbs to MIS_TAKEOFF_ALT as it was set."""
        name = "MIS_TAKEOFF_ALT"
        self.arm()
        self.change(name, 6.0)
        start = self.position()[2]
        self.command(mav.TAKE_OFF)
        self.await_mode("hold", 30.0)
        self.run(2.0)
        climbed_m = start - self.position()[2]
        require(abs(climbed_m - 6.0) < 1.0, f"climbed {climbed_m:.1f} m")
