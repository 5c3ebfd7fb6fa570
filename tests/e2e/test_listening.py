"""Nothing that flies listens beyond this computer unless it is configured to."""

from __future__ import annotations

import ipaddress
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from tests.ports import free_port

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/net/udp").exists(), reason="/proc lists the listeners"),
]
PATIENCE_S = 60.0
TCP_LISTEN = "0A"


def bound_hosts(pid: int) -> Iterator[tuple[str, str, int]]:
    """Kind, address and port of every socket of a process that others can send to."""
    inodes = set()
    for entry in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(FileNotFoundError):  # closed since the folder was listed
            target = str(entry.readlink())
            if target.startswith("socket:["):
                inodes.add(target[8:-1])
    for kind in ("tcp", "udp", "tcp6", "udp6"):
        table = Path(f"/proc/{pid}/net/{kind}")
        for line in table.read_text().splitlines()[1:] if table.exists() else ():
            fields = line.split()
            if fields[9] in inodes and (kind.startswith("udp") or fields[3] == TCP_LISTEN):
                address, port = fields[1].split(":")
                yield kind, host_of(address), int(port, 16)


def host_of(text: str) -> str:
    """An address as the kernel prints it, in words of 32 bits of this machine's order."""
    words = [int(text[at : at + 8], 16).to_bytes(4, sys.byteorder) for at in range(0, len(text), 8)]
    return str(ipaddress.ip_address(b"".join(words)))


@pytest.mark.parametrize(
    "options",
    [(), ("--ranging", "udp::{b}"), ("--radio", "ndjson@udp::{b}"), ("--gcs", "tcpin::{b}")],
    ids=["autopilot", "ranging", "radio", "station"],
)
def test_a_companion_listens_to_this_computer_alone(
    tmp_path: Path, options: tuple[str, ...]
) -> None:
    ports = {"a": free_port(), "b": free_port()}
    given = [word.format(**ports) for word in ("--connect", "udp::{a}", *options)]
    command = [sys.executable, "-m", "companion", *given]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.DEVNULL) as process:
        try:
            expected = {ports["a"]} | ({ports["b"]} if options else set())
            found = list(bound_hosts(process.pid))
            until_s = time.monotonic() + PATIENCE_S
            while not expected <= {port for _, _, port in found}:
                assert time.monotonic() < until_s
                assert process.poll() is None
                time.sleep(0.05)
                found = list(bound_hosts(process.pid))
            assert {host for _, host, _ in found} == {"127.0.0.1"}
        finally:
            process.kill()
