"""Builders of vehicles, links and files from the options; several run behind one shell.

Vehicle n (from 0) has the system id of the scenario plus n, and so has every port but the ground
station's, to which all of them send, as PX4's simulated vehicles do. In one process their links are
numbered consecutively and their steps alternate.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from companion.config.loader import load_yaml
from companion.errors import ConfigError
from companion.io.files import check_writable, read_bytes, write_json_atomic, write_text_atomic
from companion.io.links.transports import Line, OwnLine, Transport, UdpFanOut, shared
from companion.io.state_directory import load_signing_key, store_signing_key
from companion.mav.endpoint import Address, Chunk
from companion.mav.signing import KEY_LENGTH, Signing
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.incidents import renew_scenario
from sim_link.autopilot.protocols.addressing import LinkMode, LinkSetup
from sim_link.autopilot.protocols.link_layer import LinkSecurity
from sim_link.autopilot.scenario import Scenario


def load_scenario(path: Path) -> Scenario:
    """Return the scenario of a YAML file, by default the canonical one; `ConfigError`: wrong."""
    return load_yaml(path, Scenario, renew_scenario)


def start_report(endpoint: SimEndpoint, seed: int, speed: float) -> dict[str, object]:
    """Return state and truth at the start: metres, degrees counter-clockwise, about `origin`."""
    vehicle, scenario = endpoint.vehicle, endpoint.vehicle.scenario
    position_enu_m = (*scenario.emitter.position_enu_m, scenario.emitter.height_m)
    names = ("latitude_deg", "longitude_deg", "altitude_m")
    position = endpoint.vehicle.origin.geodetic_from_enu(position_enu_m)
    emitter = {"id": scenario.emitter.emitter_id, "enu_m": list(position_enu_m)}
    return {
        "version": 1,  # of this form
        "state": "running",
        "scenario": scenario.name,
        "seed": seed,
        "speed": speed,
        "system_id": scenario.system_id,
        "time_limit_s": scenario.time_limit_s,
        "origin": msgspec.to_builtins(scenario.origin),
        "area_m": list(scenario.area_m),
        "start_enu_m": list(vehicle.home_enu_m),
        "emitter": emitter | dict(zip(names, position, strict=True)),
        "offsets": {
            "range_m": scenario.channel.range_offset_m,
            "bearing_deg": scenario.channel.bearing_offset_deg,
        },
        "channel": msgspec.to_builtins(scenario.channel),
        "obstacles": msgspec.to_builtins(scenario.obstacles),
        "shadow": msgspec.to_builtins(scenario.shadow),
    }


def end_report(endpoint: SimEndpoint, seed: int, speed: float) -> dict[str, object]:
    """Return the start report with `state` "ended" and the results of the flight."""
    vehicle, recorder = endpoint.vehicle, endpoint.recorder
    return start_report(endpoint, seed, speed) | {
        "state": "ended",
        "simulated_s": vehicle.time_s,
        "distance_m": vehicle.aircraft.distance_m,
        "flight_time_s": vehicle.aircraft.flight_time_s,
        "is_armed": vehicle.is_armed,
        "setpoints_received": vehicle.setpoints.received,
        "setpoints_refused": vehicle.setpoints.refused,
        "longest_setpoint_gap_s": vehicle.setpoints.longest_gap_s,
        "mode_changes": [
            {"time_s": change.time_s, "mode": change.mode.value, "text": change.text}
            for change in recorder.mode_changes
        ],
        "track": [[round(value, 3) for value in point] for point in recorder.track],
    }


class Fleet:
    """Independent endpoints behind one loop; each has `links_each` consecutive links."""

    def __init__(self, endpoints: Sequence[SimEndpoint], links_each: int) -> None:
        self.endpoints = tuple(endpoints)
        self._links_each = links_each

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Pass bytes to the vehicle of their link."""
        index, link = divmod(chunk.link, self._links_each)
        self.endpoints[index].receive(chunk._replace(link=link), now_s)

    def handle_timer(self, now_s: float) -> None:
        """Step every vehicle that is due."""
        for endpoint in self.endpoints:
            if endpoint.next_timer_s() <= now_s:
                endpoint.handle_timer(now_s)

    def next_timer_s(self) -> float:
        """Return the earliest timer of all vehicles, s."""
        return min(endpoint.next_timer_s() for endpoint in self.endpoints)

    def take_output(self) -> list[Chunk]:
        """Collect the output of all vehicles, with fleet-wide link numbers."""
        return [
            chunk.readdressed(index * self._links_each + chunk.link, chunk.peer)
            for index, endpoint in enumerate(self.endpoints)
            for chunk in endpoint.take_output()
        ]

    def request_stop(self, now_s: float) -> None:
        """Finish at once."""
        for endpoint in self.endpoints:
            endpoint.request_stop(now_s)

    @property
    def is_finished(self) -> bool:
        """True if every vehicle has finished."""
        return all(endpoint.is_finished for endpoint in self.endpoints)


STATION_PORT = 14550
"""UDP port of ground stations, the same for every vehicle."""
PX4_PORTS: dict[int, tuple[LinkMode, int]] = {
    STATION_PORT: ("station", 3990),
    14030: ("narrow", -300),
}
"""Kind of link by the port that PX4 sends to, and its own port's offset from 14580."""
MAX_PORT = 65_535
MAX_SYSTEM_ID = 255
SAVE_PERIOD_S = 1.0
NO_KEY = 2 * KEY_LENGTH * "0"
"""Key with which SETUP_SIGNING switches signing off."""


@dataclass(frozen=True, slots=True)
class FleetOptions:
    """Options of the command line."""

    scenario: Scenario
    seed: int
    speed: float
    listen: Address
    send_to: tuple[Address, ...]
    links: tuple[tuple[Transport, LinkMode | None], ...] = ()
    """Links besides UDP, with the kind of their peers; serial lines only for a single vehicle."""
    shares_ports: bool = False
    """True if several clients may share a UDP port of PX4."""
    parameters: Path | None = None
    signing_key: Path | None = None
    report: Path | None = None


def make_vehicles(options: FleetOptions) -> list[SimEndpoint]:
    """Return one endpoint per vehicle; `ConfigError`: a parameter, its file, key or id is bad."""
    scenario = options.scenario
    last = scenario.system_id + scenario.vehicles - 1
    if last > MAX_SYSTEM_ID:
        raise ConfigError(f"{scenario.vehicles} vehicles: system ids would go beyond 255")
    ports, own = udp_ports(options), scenario.autopilot.link_mode
    setups = [
        LinkSetup(mode or own, is_px4(options) and not options.shares_ports) for mode, *_ in ports
    ]
    setups += [LinkSetup(mode or own) for _, mode in options.links]
    lines = frozenset(
        number
        for number, (link, _) in enumerate(options.links, len(ports))
        if isinstance(link, Line)
    )
    loopback = frozenset(range(len(ports)) if options.listen[0] == "127.0.0.1" else ())
    endpoints = []
    for number in range(scenario.vehicles):
        path = numbered_path(options.parameters, number)
        endpoint = SimEndpoint(
            msgspec.structs.replace(scenario, system_id=scenario.system_id + number),
            options.seed + number,
            links=setups,
            parameters=stored_parameters(path),
            parameters_name=str(path),
            security=LinkSecurity(_signing(options.signing_key), lines, loopback, time.time()),
        )
        endpoints.append(endpoint)
    return endpoints


def _signing(path: Path | None) -> Signing | None:
    return None if path is None or has_signing_ended(path) else Signing(load_signing_key(path))


def has_signing_ended(path: Path) -> bool:
    """Return True if a client ended signing: then the file holds the key of zeros."""
    try:
        return read_bytes(path).decode("ascii").strip() == NO_KEY
    except (OSError, UnicodeDecodeError):
        return False  # loading the key reports what is wrong


def is_px4(options: FleetOptions) -> bool:
    """Return True if PX4 is simulated."""
    return options.scenario.autopilot.flavour == "px4"


def udp_ports(options: FleetOptions) -> list[tuple[LinkMode | None, int, tuple[Address, ...]]]:
    """Return the first vehicle's UDP links: kind, bound port, and default destinations.

    PX4 has one for companions and one for each of `PX4_PORTS` that it is to send to.
    """
    listen, special = options.listen[1], PX4_PORTS if is_px4(options) else {}
    others = tuple(each for each in options.send_to if each[1] not in special)
    ports: list[tuple[LinkMode | None, int, tuple[Address, ...]]] = [(None, listen, others)]
    for to, (mode, above) in special.items():
        addresses = tuple(each for each in options.send_to if each[1] == to)
        if addresses:
            ports.append((mode, listen + above, addresses))
    return ports


def link_specs(options: FleetOptions, number: int) -> list[Transport]:
    """Return a vehicle's links; `ConfigError`: a port too high, or a line for several."""
    specs: list[Transport] = []
    for _, port, addresses in udp_ports(options):
        remotes = tuple(
            address if address[1] == STATION_PORT else (address[0], _port(address[1] + number))
            for address in addresses
        )
        specs.append(UdpFanOut(options.listen[0], _port(port + number), remotes))
    for link, _ in options.links:
        if not isinstance(link, Line | OwnLine):
            specs.append(shared(replace(link, port=_port(link.port + number))))
        elif options.scenario.vehicles > 1:
            raise ConfigError(f"--link {link}: a line is for one vehicle only")
        else:
            specs.append(link)
    return specs


def links_of_others(options: FleetOptions) -> list[Transport]:
    """Return a link from a free port for each other vehicle with its own address."""
    others = [each for each in options.scenario.other_vehicles if each.has_own_address]
    return [UdpFanOut(options.listen[0], 0, options.send_to) for _ in others]


def _port(port: int) -> int:
    if port > MAX_PORT:
        raise ConfigError(f"port {port}: beyond {MAX_PORT}; choose a lower one for the first")
    return port


def numbered_path(path: Path | None, number: int) -> Path | None:
    """Return the file of vehicle `number`, as in `report.json`, `report-2.json`, or None."""
    if path is None or number == 0:
        return path
    return path.with_name(f"{path.stem}-{number + 1}{path.suffix}")


def stored_parameters(path: Path | None) -> str:
    """Return the text of a parameter file, empty without one; `ConfigError`: no access."""
    if path is None:
        return ""
    check_writable(path)
    try:
        return read_bytes(path).decode("utf-8")
    except FileNotFoundError:
        return ""
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: not a text of parameters, `NAME VALUE` in each line") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error


Report = Callable[[SimEndpoint, int, float], dict[str, object]]


class FleetFiles:
    """Reports, parameters and the key, written as they change."""

    def __init__(self, options: FleetOptions, endpoints: Sequence[SimEndpoint]) -> None:
        self._options = options
        self._endpoints = endpoints
        self._saved = ["" if options.parameters is None else e.parameters_text for e in endpoints]
        self._next_save_s = 0.0

    def begin(self) -> None:
        """Write the reports of the start; `ConfigError`: they cannot be written."""
        self._write_reports(start_report)

    def _write_reports(self, report: Report) -> None:
        for number, endpoint in enumerate(self._endpoints):
            path = numbered_path(self._options.report, number)
            if path is not None:
                seed = self._options.seed + number
                write_json_atomic(path, report(endpoint, seed, self._options.speed))

    def keep(self, now_s: float) -> None:
        """Store a new key at once, and parameters that changed at most once a second."""
        self._keep_key()
        if self._options.parameters is None or now_s < self._next_save_s:
            return
        self._next_save_s = now_s + SAVE_PERIOD_S
        for number, endpoint in enumerate(self._endpoints):
            text = endpoint.parameters_text
            path = numbered_path(self._options.parameters, number)
            if path is not None and text != self._saved[number]:
                write_text_atomic(path, text)
                self._saved[number] = text

    def _keep_key(self) -> None:
        """Keep a client's key, or the end of signing, if there is a file."""
        for endpoint in self._endpoints:
            setup = endpoint.links.take_setup()
            path = self._options.signing_key
            if setup is None or path is None:
                continue
            if setup.key is None:
                write_text_atomic(path, f"{NO_KEY}\n", mode=0o600)
            else:
                store_signing_key(path, setup.key)

    def end(self) -> None:
        """Write the reports of the end, and parameters that changed last."""
        self._next_save_s = 0.0
        self.keep(0.0)
        self._write_reports(end_report)
