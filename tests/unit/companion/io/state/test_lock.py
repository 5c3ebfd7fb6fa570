"""One companion per vehicle, with real processes where the kernel's word counts."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from companion.errors import LinkError
from companion.io.links.transports import Pty, SerialPort, UdpBind, UdpConnect
from companion.io.state_directory import VehicleLock, lock_name, resolved_address

UDP = "udpin:127.0.0.1:14550"
HOLD = """
import sys
from pathlib import Path
from companion.io.state_directory import VehicleLock
lock = VehicleLock(Path(sys.argv[1]), sys.argv[2], None)
print("held", flush=True)
sys.stdin.read()
"""


def test_a_second_companion_on_a_link_is_refused_by_name(tmp_path: Path) -> None:
    first = VehicleLock(tmp_path, UDP, None)
    with pytest.raises(LinkError) as caught:
        VehicleLock(tmp_path, UDP, None)
    assert str(caught.value) == (
        f"{UDP}: another companion (process {os.getpid()}) has this vehicle; stop it, or choose "
        "another link or vehicle.system_id"
    )
    first.release()
    first.release()
    VehicleLock(tmp_path, UDP, None).release()


def test_another_link_is_another_vehicle(tmp_path: Path) -> None:
    locks = [VehicleLock(tmp_path, link, None) for link in (UDP, "tcp:10.0.0.1:5760", "/dev/ttyS0")]
    for lock in locks:
        lock.release()


def test_another_spelling_of_a_host_is_the_same_vehicle(tmp_path: Path) -> None:
    links = [UdpConnect(host, 14580) for host in ("127.0.0.1", "localhost")]
    first = VehicleLock(tmp_path, "udpout 127.0.0.1:14580", None, resolved_address(links[0]))
    with pytest.raises(LinkError, match="udpout localhost:14580: another companion"):
        VehicleLock(tmp_path, "udpout localhost:14580", None, resolved_address(links[1]))
    first.release()


def test_another_name_or_speed_of_a_serial_port_is_the_same_vehicle(tmp_path: Path) -> None:
    device, by_id = tmp_path / "ttyACM0", tmp_path / "usb-autopilot"
    device.touch()
    by_id.symlink_to(device)
    links = (SerialPort(str(device), 57_600), SerialPort(str(by_id), 921_600))
    assert resolved_address(links[0]) == resolved_address(links[1])


def test_a_pseudo_terminal_is_known_by_its_name_whether_it_is_open_or_not(tmp_path: Path) -> None:
    link = Pty(str(tmp_path / "vehicle"))
    before = resolved_address(link)
    (tmp_path / "vehicle").symlink_to("/dev/pts/0")
    assert resolved_address(link) == before


def test_other_ports_hosts_and_kinds_are_other_vehicles() -> None:
    links = (
        UdpConnect("127.0.0.1", 14580),
        UdpConnect("127.0.0.1", 14581),
        UdpConnect("127.0.0.2", 14580),
        UdpBind("127.0.0.1", 14580),
        UdpConnect("nobody.invalid", 14580),
    )
    assert len({resolved_address(link) for link in links}) == len(links)


def test_vehicles_behind_one_router_are_distinguished_by_their_ids(tmp_path: Path) -> None:
    locks = [VehicleLock(tmp_path, UDP, system_id) for system_id in (1, 2)]
    for system_id in (1, 2, None):
        with pytest.raises(LinkError, match="another companion"):
            VehicleLock(tmp_path, UDP, system_id)
    for lock in locks:
        lock.release()
    alone = VehicleLock(tmp_path, UDP, None)
    with pytest.raises(LinkError, match="another companion"):
        VehicleLock(tmp_path, UDP, 1)
    alone.release()


def test_a_refused_companion_keeps_nothing_from_others(tmp_path: Path) -> None:
    one = VehicleLock(tmp_path, UDP, 1)
    with pytest.raises(LinkError):
        VehicleLock(tmp_path, UDP, 1)
    VehicleLock(tmp_path, UDP, 2).release()
    one.release()
    VehicleLock(tmp_path, UDP, None).release()


def test_a_killed_companion_leaves_no_lock(tmp_path: Path) -> None:
    command = [sys.executable, "-c", HOLD, str(tmp_path), UDP]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(LinkError, match=f"process {holder.pid}"):
            VehicleLock(tmp_path, UDP, None)
        holder.send_signal(signal.SIGKILL)
        holder.wait()
        VehicleLock(tmp_path, UDP, None).release()


def test_a_place_that_keeps_no_locks_is_reported_and_flown_without(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("")
    VehicleLock(tmp_path / "file" / "locks", UDP, None).release()
    assert "no lock can be kept" in caplog.text


@pytest.mark.parametrize("link", [UDP, "serial:/dev/serial/by-id/usb-a:b:921600", "x" * 500])
def test_any_link_makes_a_file_name(link: str) -> None:
    name = lock_name(link)
    assert "/" not in name
    assert len(name) < 80
    assert name != lock_name(link + "0")
