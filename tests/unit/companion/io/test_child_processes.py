"""Ports for the processes of a flight."""

from __future__ import annotations

from companion.io.child_processes import free_udp_ports


def test_ports_of_one_flight_are_all_different() -> None:
    """Picked one after another, among so many of the system's there are almost always two alike."""
    ports = free_udp_ports(500)
    assert len(set(ports)) == 500
