"""Radios that print received power alone: real processes over the lines of the real ones."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from sim_link.autopilot.scenario import Scenario
from tests.e2e.test_radios_fly import BIN, BY_PROGRAM, BY_TCP, BY_UDP, Process, write
from tests.ports import free_port
from tests.radio_formats import POWERS, Format

pytestmark = pytest.mark.slow


@pytest.fixture
def started() -> Iterator[list[Process]]:
    processes: list[Process] = []
    yield processes
    for process in reversed(processes):
        process.end()


def lines_of(directory: Path, name: str) -> tuple[str, str]:
    """Return the address that the emulator prints to, and that of the companion."""
    port = free_port()
    if name in BY_UDP:
        return f"udpout:127.0.0.1:{port}", f"udp:127.0.0.1:{port}"
    if name in BY_TCP:
        return f"tcpin:127.0.0.1:{port}", f"tcp:127.0.0.1:{port}"
    if name in BY_PROGRAM:
        return "stdout:", ""
    return f"pty:{directory}/uart", f"serial:{directory}/uart:115200"


@pytest.mark.parametrize("format_", POWERS, ids=lambda each: str(each.name))
def test_powers_arrive_and_the_radio_is_named(
    format_: Format, tmp_path: Path, started: list[Process]
) -> None:
    on_ground = msgspec.structs.replace(Scenario().payload, min_altitude_m=0.0, max_range_m=1e3)
    write(tmp_path / "radio.yaml", msgspec.structs.replace(Scenario(), payload=on_ground))
    follow, (to, at) = free_port(), lines_of(tmp_path, format_.name)
    words = (
        *("sim-link", "radio", "--follow", f"tcp:127.0.0.1:{follow}", "--as", format_.name),
        *("--to", to, "--scenario", "radio.yaml", "--seed", "1"),
    )
    listen = f"127.0.0.1:{free_port()}"
    vehicle = ("sim-link", "--listen", listen, "--link", f"tcpin:127.0.0.1:{follow}")
    started.append(Process(tmp_path, *vehicle))
    if at:
        started.append(Process(tmp_path, *words))
        started[-1].wait_for("sim-link: radio on")
    else:
        at = "exec:" + " ".join((str(BIN / words[0]), *words[1:]))
    emitter_id = Scenario().emitter.emitter_id
    names = f"emitters={{'{format_.kind.name_on_wire(emitter_id)}': {emitter_id}}}"
    watch = Process(tmp_path, "companion", "radio", "watch", f"{format_.radio}:{names}@{at}")
    started.append(watch)

    watch.wait_for(" dBm")
    line = next(each for each in watch.lines if " dBm" in each)
    found = re.search(rf"emitter {emitter_id} .* power +(-[0-9.]+) dBm", line)
    assert found is not None, line
    assert -120.0 < float(found[1]) < -30.0
    watch.end()
    started.remove(watch)

    identify = Process(tmp_path, "companion", "radio", "identify", f"@{at}")
    started.append(identify)
    identify.wait_to_end()
    assert identify.count(f"{format_.radio}: ") == 1, identify.lines
