"""All rules, in the order in which they are tried."""

from __future__ import annotations

from sim_link.conformance.companion_rules import commands as companion_commands
from sim_link.conformance.companion_rules import identity, setpoints
from sim_link.conformance.rules import Rule
from sim_link.conformance.vehicle_rules import (
    arming,
    clocks,
    commands,
    failsafes,
    fences,
    flights,
    frames,
    guided,
    heartbeat,
    missions,
    offboard,
    offboard_loss,
    parameters,
    plan_results,
    routing,
    signing,
    streams,
    telemetry,
    uploads,
)

BOOKS = (
    frames.book,
    heartbeat.book,
    routing.book,
    signing.book,
    commands.book,
    clocks.book,
    streams.book,
    telemetry.book,
    parameters.book,
    missions.book,
    uploads.book,
    plan_results.book,
    fences.book,
    arming.book,
    flights.book,
    offboard.book,
    offboard_loss.book,
    guided.book,
    failsafes.book,
    identity.book,
    companion_commands.book,
    setpoints.book,
)


def all_rules() -> list[Rule]:
    """Every rule of every role."""
    return [rule for book in BOOKS for rule in book.rules]
