"""Parameters: listed, read, set, echoed; encoded as the flavour does; never created."""

from __future__ import annotations

import math
import struct

from companion.mav.dialect import mavlink
from sim_link.lab.conformance.mavlink_oracle import OBSERVED_ARDUPILOT, OBSERVED_PX4
from sim_link.lab.conformance.protocol_clients import (
    ANSWER_S,
    ARDUPILOT_NAMES,
    INT32,
    PX4_NAMES,
    REAL32,
    SERVICE,
    STRICT,
    Error,
    Value,
    await_value,
    float_name,
    integer_name,
    read,
    read_all,
    request_read,
    restored,
    values_since,
    write,
)
from sim_link.lab.conformance.rules import (
    ARDUPILOT_ONLY,
    CHANGES,
    FLIES,
    PX4_ONLY,
    NotApplicable,
    Role,
    RuleBook,
    require,
)
from sim_link.lab.conformance.vehicle_probe import NAN, VehicleProbe

book = RuleBook(Role.VEHICLE, "parameters")


@book.rule(SERVICE)
def list_is_complete(probe: VehicleProbe) -> None:
    """PARAM_REQUEST_LIST sends every index from 0 to count - 1, and one constant count."""
    found = read_all(probe)
    counts = {p.count for p in found}
    require(counts == {len(found)}, f"counts {sorted(counts)}, {len(found)} parameters")
    indices = [p.index for p in found]
    require(indices == list(range(len(found))), "indices are not 0 to count - 1")
    require(len({p.name for p in found}) == len(found), "a name comes twice")


@book.rule(f"{SERVICE} (streams are paced)")
def list_is_paced(probe: VehicleProbe) -> None:
    """The list does not come in one burst, and the heartbeat goes on meanwhile."""
    mark = probe.mark
    found = read_all(probe)
    times = probe.times(Value, mark)
    if len(found) < 20:
        raise NotApplicable("too few parameters to tell")
    require(len(set(times)) > 3, f"{len(found)} parameters in {len(set(times))} moments")


@book.rule(SERVICE)
def names_fit(probe: VehicleProbe) -> None:
    """Names have 1 to 16 characters of A to Z, 0 to 9 and underscore."""
    for found in read_all(probe):
        good = 1 <= len(found.name) <= 16 and found.name.replace("_", "A").isalnum()
        require(good, f"`{found.name}`")


@book.rule(
    f"{SERVICE}; {OBSERVED_PX4}; {OBSERVED_ARDUPILOT}",
    px4="INT32 and REAL32 only",
    ardupilot="INT8, INT16, INT32 and REAL32",
)
def types_are_the_flavours(probe: VehicleProbe) -> None:
    """Only the types occur that the flavour has."""
    allowed = {INT32, REAL32} if probe.is_px4 else {2, 4, INT32, REAL32}
    kinds = {p.kind for p in read_all(probe)}
    require(kinds <= allowed, f"types {sorted(kinds)}")


@book.rule(SERVICE)
def values_are_finite(probe: VehicleProbe) -> None:
    """Every value of type REAL32 is a number."""
    for found in read_all(probe):
        if found.kind == REAL32:
            require(math.isfinite(found.value(probe)), f"{found.name} is not finite")


@book.rule("PX4 and ArduPilot parameter references; MAVSDK and ground stations ask for these")
def needed_parameters_exist(probe: VehicleProbe) -> None:
    """The parameters that clients ask for by name are there."""
    for name in PX4_NAMES if probe.is_px4 else ARDUPILOT_NAMES:
        read(probe, name)


@book.rule(SERVICE)
def read_by_index_and_by_name_agree(probe: VehicleProbe) -> None:
    """A parameter read by index is the same as by name."""
    for listed in read_all(probe)[::7][:10]:
        by_index = await_value(probe, request_read(probe, "", listed.index), listed.name)
        by_name = read(probe, listed.name)
        same = (by_index.raw, by_index.kind) == (by_name.raw, by_name.kind)
        require(same and by_index.count == listed.count, f"{listed.name} differs")


@book.rule(f"{SERVICE} (16 characters without a NUL)")
def longest_names_are_found(probe: VehicleProbe) -> None:
    """A name of 16 characters, sent without a NUL, is found."""
    names = [p.name for p in read_all(probe) if len(p.name) == 16]
    if not names:
        raise NotApplicable("no parameter has a name of 16 characters")
    read(probe, names[0])


@book.rule(SERVICE, effect=CHANGES)
def set_is_echoed_and_kept(probe: VehicleProbe) -> None:
    """PARAM_SET is answered by PARAM_VALUE with the new value, and a read shows it."""
    for name, value in ((float_name(probe), 4.25), (integer_name(probe), 1.0)):
        with restored(probe, name) as before:
            mark = write(probe, name, value, before.kind)
            echoed = await_value(probe, mark, name)
            require(echoed.value(probe) == value, f"{name}: echo {echoed.value(probe)}")
            require(echoed.kind == before.kind, f"{name}: type {echoed.kind}")
            require(read(probe, name).value(probe) == value, f"{name} was not kept")


@book.rule(SERVICE, effect=CHANGES)
def set_of_an_equal_value_is_echoed(probe: VehicleProbe) -> None:
    """PARAM_SET with the present value is echoed, too."""
    name = float_name(probe)
    before = read(probe, name)
    mark = write(probe, name, before.value(probe), before.kind)
    require(await_value(probe, mark, name).raw == before.raw, "another value")


def require_encoded(
    probe: VehicleProbe, kinds: tuple[int, ...], value: float, wanted: bytes
) -> None:
    """An integer of one of the types must be told as certain bytes."""
    name = integer_name(probe)
    with restored(probe, name) as before:
        require(before.kind in kinds, f"{name} has type {before.kind}")
        told = await_value(probe, write(probe, name, value, before.kind), name)
        require(told.raw == wanted, f"{value:g} is sent as {told.raw.hex()}")


@book.rule(f"{SERVICE} (bytewise encoding)", effect=CHANGES, flavours=PX4_ONLY)
def integers_are_encoded_bytewise(probe: VehicleProbe) -> None:
    """An INT32 travels as its four bytes in the float field."""
    require_encoded(probe, (INT32,), 3.0, b"\x03\x00\x00\x00")


@book.rule(f"{SERVICE} (bytewise encoding)", effect=CHANGES, flavours=PX4_ONLY)
def negative_integers_survive(probe: VehicleProbe) -> None:
    """A negative INT32, whose bytes are a NaN, survives set, echo and read."""
    names = [p for p in read_all(probe) if p.kind == INT32 and p.value(probe) < 0.0]
    if not names:
        raise NotApplicable("no INT32 parameter is negative")
    chosen = names[0]
    mark = probe.mark
    body = chosen.raw + bytes(probe.target) + chosen.name.encode().ljust(16, b"\0") + b"\x06"
    probe.send_payload(mavlink.MAVLink_param_set_message, body)
    require(await_value(probe, mark, chosen.name).raw == chosen.raw, f"{chosen.name} changed")


@book.rule(
    f"{SERVICE} (C-cast encoding); {OBSERVED_ARDUPILOT}",
    effect=CHANGES,
    flavours=ARDUPILOT_ONLY,
)
def integers_are_cast_to_float(probe: VehicleProbe) -> None:
    """An integer travels as the float of the same value."""
    require_encoded(probe, (2, 4, INT32), 1.0, struct.pack("<f", 1.0))


def require_unknown(probe: VehicleProbe, mark: int, what: str) -> None:
    """PARAM_ERROR must follow (ArduPilot may be silent), and no PARAM_VALUE."""
    told = probe.run_until(lambda: bool(probe.heard(Error, mark)), ANSWER_S)
    require(not values_since(probe, mark), f"{what}: a value is told")
    require(told or not probe.is_px4, f"{what}: no PARAM_ERROR")
    read(probe, float_name(probe))


STRICTER = "PX4 1.15 is silent; clients wait for PARAM_ERROR"
SILENT = "may be silent, as ArduCopter 4.5 is"


@book.rule("MAVLink common, PARAM_ERROR; MAVSDK 4.1 reports it", px4=STRICTER, ardupilot=SILENT)
def unknown_name_is_an_error(probe: VehicleProbe) -> None:
    """Reading a name that there is not is answered by PARAM_ERROR."""
    require_unknown(probe, request_read(probe, "NO_SUCH_PARAM"), "read by name")


@book.rule("MAVLink common, PARAM_ERROR; MAVSDK 4.1 reports it", px4=STRICTER, ardupilot=SILENT)
def unknown_index_is_an_error(probe: VehicleProbe) -> None:
    """Reading an index that there is not is answered by PARAM_ERROR."""
    for index in (30_000, 32_767):
        require_unknown(probe, request_read(probe, "", index), f"index {index}")


@book.rule(SERVICE, effect=CHANGES, px4=STRICTER, ardupilot=SILENT)
def set_never_creates_a_parameter(probe: VehicleProbe) -> None:
    """Setting a name that there is not creates nothing and is answered by PARAM_ERROR."""
    count = read(probe, float_name(probe)).count
    mark = write(probe, "NO_SUCH_PARAM", 1.0, REAL32)
    require_unknown(probe, mark, "set")
    require(read(probe, float_name(probe)).count == count, "there is one more")


def require_kept(probe: VehicleProbe, name: str, wait_s: float, *values: float) -> None:
    """A parameter must keep its value when others, of type REAL32, are set."""
    before = read(probe, name)
    for value in values:
        write(probe, name, value, REAL32)
        probe.run(wait_s)
        require(read(probe, name).raw == before.raw, f"{name}: {value} was stored")


@book.rule(
    f"{SERVICE} {STRICT}",
    effect=CHANGES,
    px4="PX4 1.15 stores a NaN",
    ardupilot="silent, value kept",
)
def nan_is_refused(probe: VehicleProbe) -> None:
    """NaN and infinity are not stored."""
    require_kept(probe, float_name(probe), 0.3, NAN, math.inf, -math.inf)


@book.rule(
    f"{SERVICE} {STRICT}",
    effect=CHANGES,
    px4="PX4 1.15 stores a NaN",
    ardupilot="silent, as ArduCopter 4.5 is, or the old value",
)
def refused_value_is_answered_by_the_old_one(probe: VehicleProbe) -> None:
    """PARAM_SET with a value that is not stored is answered by PARAM_VALUE with the old value."""
    name = float_name(probe)
    before = read(probe, name)
    mark = write(probe, name, NAN, REAL32)
    probe.run(ANSWER_S)
    told = values_since(probe, mark, name)
    require(bool(told) or not probe.is_px4, "not answered")
    require(all(each.raw == before.raw for each in told), "another value is told")
    require(read(probe, name).raw == before.raw, "it was stored")


@book.rule(f"{SERVICE} (a text)", px4=STRICTER, ardupilot=SILENT)
def unknown_name_is_told_in_words(probe: VehicleProbe) -> None:
    """Reading or setting a name that there is not is answered by a STATUSTEXT, too."""
    for message in (
        mavlink.MAVLink_param_request_read_message(*probe.target, b"NO_SUCH_PARAM", -1),
        mavlink.MAVLink_param_set_message(*probe.target, b"NO_SUCH_PARAM", 1.0, REAL32),
    ):
        mark = probe.mark
        probe.send(message)
        probe.run(ANSWER_S)
        texts = probe.heard(mavlink.MAVLink_statustext_message, mark)
        told = any("NO_SUCH_PARAM" in text.text for text in texts)
        require(told or not probe.is_px4, f"{message.get_type()}: no text")
    probe.require_hearing()


@book.rule(f"{SERVICE}; {OBSERVED_PX4}", effect=CHANGES, flavours=PX4_ONLY)
def wrong_type_is_refused(probe: VehicleProbe) -> None:
    """A value of another type is not stored."""
    require_kept(probe, integer_name(probe), 0.5, 1.5)


@book.rule(
    f"{SERVICE} {STRICT}",
    effect=CHANGES,
    flavours=PX4_ONLY,
    px4="PX4 1.15 stores what is out of range",
)
def value_out_of_range_is_refused(probe: VehicleProbe) -> None:
    """A value outside the parameter's range is not stored."""
    require_kept(probe, "COM_OF_LOSS_T", 0.5, -5.0)


@book.rule("MAVLink guide, Routing", effect=CHANGES)
def other_systems_parameters_are_left_alone(probe: VehicleProbe) -> None:
    """PARAM_SET and PARAM_REQUEST_READ for another system are ignored."""
    name = float_name(probe)
    before = read(probe, name)
    mark = write(probe, name, before.value(probe) + 1.0, REAL32, (77, 1))
    probe.send(mavlink.MAVLink_param_request_read_message(77, 1, name.encode(), -1))
    probe.run(1.0)
    require(not values_since(probe, mark, name), "answered")
    require(read(probe, name).raw == before.raw, "stored")


@book.rule(SERVICE)
def broadcast_read_is_answered(probe: VehicleProbe) -> None:
    """A read for component 0 is answered."""
    name = float_name(probe)
    mark, system = probe.mark, probe.target[0]
    probe.send(mavlink.MAVLink_param_request_read_message(system, 0, name.encode(), -1))
    await_value(probe, mark, name)


@book.rule(SERVICE, effect=FLIES, flavours=PX4_ONLY)
def changed_takeoff_altitude_is_flown(probe: VehicleProbe) -> None:
    """A take-off without altitude climbs to MIS_TAKEOFF_ALT as it was set."""
    before = read(probe, "MIS_TAKEOFF_ALT")
    probe.arm()
    await_value(probe, write(probe, "MIS_TAKEOFF_ALT", 6.0, REAL32), "MIS_TAKEOFF_ALT")
    start = probe.place()[2]
    probe.command(mavlink.MAV_CMD_NAV_TAKEOFF)
    probe.await_mode("hold", 30.0)
    probe.run(2.0)
    climbed_m = start - probe.place()[2]
    write(probe, "MIS_TAKEOFF_ALT", before.value(probe), REAL32)
    probe.run(0.2)
    require(abs(climbed_m - 6.0) < 1.0, f"climbed {climbed_m:.1f} m")
