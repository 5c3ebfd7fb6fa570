"""The simulator and the companion, each in memory and ready to be probed."""

from __future__ import annotations

from companion.config.schema import CompanionConfig
from companion.flight_setup import build_endpoint
from companion.guidance.commands import SessionParams
from companion.mav.endpoint import Endpoint
from companion.mav.signing import Signing, SigningKey
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.protocols.link_layer import LinkSecurity
from sim_link.autopilot.scenario import AutopilotParams, Scenario
from sim_link.lab.conformance.cli import all_rules
from sim_link.lab.conformance.puppet import CompanionProbe, stay_silent
from sim_link.lab.conformance.rules import Flavour, Role, Rule, RuleOutcome, try_rule
from sim_link.lab.conformance.vehicle_probe import VehicleProbe
from sim_link.lab.lockstep import MemoryJournal
from tests.protocol.memory_link import MemoryHub

SEED = 1
KEY = bytes(range(7, 39))
STARTED_UNIX_S = 1_800_000_000.0
BY_ID = {rule.rule_id: rule for rule in all_rules()}
LAUNCHES_BY_ITSELF = CompanionConfig(mission=SessionParams(engage="auto"))


def simulator(flavour: Flavour) -> SimEndpoint:
    """A simulated vehicle at its boot."""
    return SimEndpoint(Scenario(autopilot=AutopilotParams(flavour=flavour.value)), SEED)


def signing_simulator(flavour: Flavour) -> SimEndpoint:
    """A simulated vehicle that was given `KEY`."""
    scenario = Scenario(autopilot=AutopilotParams(flavour=flavour.value))
    signing = Signing(SigningKey(KEY))
    return SimEndpoint(
        scenario, SEED, security=LinkSecurity(signing, started_unix_s=STARTED_UNIX_S)
    )


def probe_of(
    endpoint: Endpoint,
    prober: type[VehicleProbe],
    signing_key: bytes | None = None,
    *,
    is_datagram: bool = True,
) -> VehicleProbe:
    """A ground station that has heard the vehicle, over datagrams or a byte stream."""
    probe = prober(MemoryHub(endpoint).connect(is_datagram=is_datagram), signing_key)
    probe.attach()
    return probe


def companion_probe(prober: type[CompanionProbe], flavour: Flavour) -> CompanionProbe:
    """A vehicle on strings that the companion has heard."""
    endpoint = build_endpoint(CompanionConfig(), MemoryJournal())
    probe = prober(MemoryHub(endpoint).connect(), flavour)
    probe.attach()
    return probe


def unanswered_companion_probe(prober: type[CompanionProbe], flavour: Flavour) -> CompanionProbe:
    """The same with a companion that launches by itself a vehicle that never answers."""
    endpoint = build_endpoint(LAUNCHES_BY_ITSELF, MemoryJournal())
    link = MemoryHub(endpoint).connect()
    probe = prober(link, flavour, stay_silent, is_flying=False)
    probe.attach()
    return probe


def try_on_vehicle(rule: Rule, endpoint: Endpoint) -> RuleOutcome:
    """Return the outcome of a rule with a vehicle in memory."""
    return try_rule(rule, probe_of(endpoint, rule.book.prober))


def cases(role: Role) -> list[tuple[Rule, Flavour]]:
    """Every rule of a role with every flavour that it binds."""
    return [
        (rule, flavour)
        for rule in all_rules()
        if rule.role is role
        for flavour in Flavour
        if flavour in rule.flavours
    ]


def case_id(value: object) -> str:
    """A rule or a flavour in the name of a test."""
    return value.rule_id if isinstance(value, Rule) else str(getattr(value, "value", value))
