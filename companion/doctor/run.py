"""Puts the doctor together: links and files to facts, facts to findings."""

from __future__ import annotations

import os
import time
from pathlib import Path

from companion.config.schema import CompanionConfig
from companion.doctor.checks import examine
from companion.doctor.facts import Facts, LinkFacts
from companion.doctor.host import look_at_host
from companion.doctor.probe import DoctorProbe
from companion.doctor.verdicts import Finding
from companion.io.clock import Clock
from companion.io.links import LinkSpec
from companion.io.lock import VehicleLock
from companion.io.shell import Shell
from companion.io.state_directory import state_directory
from companion.link.authenticity import Authenticity
from companion.run import link_name, open_signing


def run_doctor(config: CompanionConfig, link: LinkSpec, duration_s: float) -> list[Finding]:
    """Look at everything.

    Args:
        config: Of the flight that is meant.
        link: The vehicle's.
        duration_s: How long streams are counted.

    Raises:
        LinkError: The link cannot be opened, or a companion flies on it.
    """
    state = state_directory(config.process.state_directory, os.environ)
    key_file = config.link.signing_key_file
    host = look_at_host(Path(config.log.directory), state, key_file)
    can_sign = host.key_problem is None
    facts = Facts(host, look_at_link(config, link, duration_s, state, can_sign=can_sign))
    return examine(facts, config)


def look_at_link(
    config: CompanionConfig, link: LinkSpec, duration_s: float, state: Path, *, can_sign: bool
) -> LinkFacts:
    """What is heard on the vehicle's link.

    Args:
        config: Of the flight that is meant.
        link: The vehicle's.
        duration_s: How long streams are counted.
        state: Where locks are.
        can_sign: Whether the key, if there is one, can be used.
    """
    name = link_name(link)
    lock = VehicleLock(state, name, config.vehicle.system_id)
    keeper = open_signing(config) if can_sign else None
    clock = Clock()
    try:
        signing = None if keeper is None else keeper.signing
        authenticity = Authenticity(signing, time.time() - clock.now_s())
        probe = DoctorProbe(name, config.vehicle.system_id, authenticity, duration_s)
        Shell(probe, [link], clock).run_blocking()
        return probe.facts()
    finally:
        if keeper is not None:
            keeper.close()
        lock.release()
