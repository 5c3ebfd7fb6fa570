"""What a newcomer would type for each recipe of CONTRIBUTING.md: its steps as edits of files.

Every specimen is small but whole: it passes the contract of its kind and the tests of its own.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Edit:
    """Text that goes behind the first match of a pattern; without a pattern, to the file's end."""

    path: str
    text: str
    behind: str = ""
    """A regular expression over lines; the file is made if there is none."""
    is_instead: bool = False
    """Whether the text replaces the match."""

    def apply(self, root: Path) -> None:
        """Change the file below `root`; AssertionError: the place is not there."""
        path = root / self.path
        before = path.read_text(encoding="utf-8") if path.exists() else ""
        begin = end = len(before)
        if self.behind:
            found = re.search(self.behind, before, re.MULTILINE)
            assert found, f"{self.path}: no place like {self.behind}"
            begin, end = found.start() if self.is_instead else found.end(), found.end()
        path.write_text(before[:begin] + self.text + before[end:], encoding="utf-8", newline="")


@dataclass(frozen=True, slots=True)
class Command:
    """A command that a step names, run by the interpreter of the tests."""

    words: tuple[str, ...]
    makes: str
    """The file that it writes."""


Steps = Mapping[int, Sequence[Edit | Command]]
"""By the number of the step on the page. Optional steps that a specimen does not need are empty."""

FILTER: Steps = {
    1: (
        Edit(
            "companion/estimation/filters/kalman.py",
            '''
@kernel
def gated_update(
    mean: Vector,
    P: Matrix,
    sensor_enu_m: Vector,
    z: Vector,
    sigma: Vector,
    late_m2: float,
    inflation: Vector,
    thresholds: Matrix,
    bounds: Matrix,
    model: RangingModel,
    gate: float,
) -> tuple[Vector, Matrix, Matrix, bool]:
    """The robust update with a deviation beyond the gate shortened to it, in sigma."""
    y, H, R = linearised(z, P, mean, sensor_enu_m, sigma, model)
    kept = z.copy()
    for row in range(y.size):
        if not math.isnan(y[row]):
            S = R[row] + np.dot(H[row], np.dot(P, H[row]))
            excess = abs(y[row]) - gate * math.sqrt(S)
            if excess > 0.0:
                kept[row] -= math.copysign(excess, y[row])
    return robust_update(
        mean, P, sensor_enu_m, kept, sigma, late_m2, inflation, thresholds, bounds, model
    )


class GatedEkf(RecursiveFilter):
    """The one-sided filter, which no single measurement moves by more than a gate."""

    def __init__(self, params: FilterParams) -> None:
        super().__init__(params, gated_update, (4.0,))

''',
            r"^        super\(\).__init__\(msgspec.structs.replace\(params, \*\*no_thresholds.*\n",
        ),
        Edit("companion/estimation/filters/kalman.py", '"gated", ', r"^FilterKind = Literal\["),
        Edit(
            "companion/estimation/filters/kalman.py",
            '    "gated": GatedEkf,\n',
            r"^KINDS: .* = \{\n",
        ),
    ),
    2: (Edit("tests/contract/filter_helpers.py", '"gated", ', r"^ROBUST = \["),),
    3: (
        Edit("configs/companion/default.yaml", " gated,", r"^  kind: asymmetric_huber +# or"),
        Edit("docs/estimation.md", "`gated`, ", r"^`estimation.kind` chooses .*\n"),
    ),
}

PLANNER: Steps = {
    1: (
        Edit(
            "companion/planning/orbit.py",
            '''"""Circles about the estimate: a planner that never flies straight at it."""

from __future__ import annotations

import math

from companion.domain import Params, Positive, Waypoint, WaypointReason
from companion.planning.planner import Plan, PlanRequest, hold_position, kept_inside, route_to


class OrbitParams(Params, frozen=True):
    """How wide, and how far ahead the next waypoint is."""

    radius_m: Positive = 15.0
    ahead_deg: Positive = 30.0


class Orbit:
    """Flies to the circle about the estimate, and around it."""

    search_after_s: float | None = None

    def __init__(self, params: OrbitParams) -> None:
        self.params = params

    def plan(self, request: PlanRequest, memory: None) -> Plan[None]:
        """The point of the circle that is next, counter-clockwise."""
        if request.estimate is None:
            return Plan(hold_position(request, "nothing to circle about"), memory)
        (east, north), (to_east, to_north) = (
            request.vehicle_enu_m,
            request.estimate.position_enu_m,
        )
        at_rad = math.atan2(north - to_north, east - to_east) + math.radians(self.params.ahead_deg)
        wanted = (
            to_east + self.params.radius_m * math.cos(at_rad),
            to_north + self.params.radius_m * math.sin(at_rad),
        )
        place = kept_inside(wanted, request.estimate.position_enu_m, request)
        waypoint = Waypoint(place, WaypointReason.INFORMATION, "around the estimate")
        return Plan(route_to(request, waypoint), memory)
''',
        ),
        Edit(
            "companion/planning/search.py",
            '''class StarParams(SectorParams, frozen=True):
    """Sectors, and between them those of the next sweep."""

    name: ClassVar[str] = "star"

    def track(self, request: PlanRequest, datum_enu_m: Point, sweep: int) -> Track:
        """Two sweeps of the sectors at once."""
        first = super().track(request, datum_enu_m, 2 * sweep)
        return (*first, *super().track(request, datum_enu_m, 2 * sweep + 1))


''',
            r"^        return sector_search\(.*\n\n\n",
        ),
    ),
    2: (
        Edit(
            "companion/config/schema.py",
            "from companion.planning.orbit import OrbitParams\n",
            r"^from companion.planning.crossing import .*\n",
        ),
        Edit("companion/config/schema.py", "    StarParams,\n", r"^    SectorParams,\n"),
        Edit("companion/config/schema.py", '"orbit", ', r"^CrossingKind = Literal\["),
        Edit("companion/config/schema.py", '"star", ', r"^PatternKind = Literal\["),
        Edit(
            "companion/config/schema.py",
            "    orbit: OrbitParams = OrbitParams()\n",
            r"^    latched_crossing: LatchedCrossingParams = .*\n",
        ),
        Edit(
            "companion/config/schema.py",
            '        if kind == "star":\n            return StarParams(spacing_m=self.spacing_m)\n',
            r"^                lane_heading_deg=self.heading_deg,\n            \)\n",
        ),
    ),
    3: (
        Edit(
            "companion/flight_setup.py",
            "from companion.planning.orbit import Orbit\n",
            r"^from companion.planning.fim import .*\n",
        ),
        Edit(
            "companion/flight_setup.py",
            '        case "orbit":\n            return Orbit(planner.orbit)\n',
            r"^            return FimPlanner\(.*\n",
        ),
    ),
    4: (
        Edit("configs/companion/default.yaml", " orbit,", r"^  kind: latched_crossing +#"),
        Edit("configs/companion/default.yaml", " star,", r"^  search: null +#"),
        Edit(
            "configs/companion/default.yaml",
            "  orbit:\n    radius_m: 15.0\n    ahead_deg: 30.0\n",
            r"^  lost_after_s: .*\n",
        ),
        Edit(
            "docs/flying.md",
            "| `orbit` | around the estimate |\n| `star` | a pattern: sectors between sectors |\n",
            r"^\| `fim` .*\n",
        ),
    ),
    5: (
        Edit(
            "tests/unit/companion/planning/test_orbit.py",
            """from __future__ import annotations

import math

from companion.domain import EstimateState, TargetEstimate
from companion.planning.orbit import Orbit, OrbitParams
from companion.planning.planner import PlanRequest


def test_it_ends_on_the_circle() -> None:
    unit = ((1.0, 0.0), (0.0, 1.0))
    seen = TargetEstimate(0.0, EstimateState.SEARCHING, (40.0, 0.0), unit, 2.0, 0.0, 0.0, 1)
    place = (0.0, 0.0)
    for _ in range(5):
        place = Orbit(OrbitParams()).plan(PlanRequest(place, seen), None).waypoint.position_enu_m
    assert abs(math.dist(place, (40.0, 0.0)) - 15.0) < 1e-9
""",
        ),
    ),
}

RADIO: Steps = {
    1: (
        Edit(
            "companion/radios/acme.py",
            '''"""Acme's radio: tag, millimetres and a checksum, as in `$ACM,7,12345*49`."""

from __future__ import annotations

import functools
import operator
import re

from companion.radios.decoder import LineDecoder, RadioKind, RadioReading

LINE = re.compile(r"\\$(ACM,([0-9]{1,5}),([0-9]{1,7}))\\*([0-9A-F]{2})")


class AcmeDecoder(LineDecoder):
    """Its lines."""

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """One range."""
        found = LINE.fullmatch(line)
        if not found:
            self.counts.resync_bytes += len(line)
            return []
        body, tag, range_mm, told = found.groups()
        if functools.reduce(operator.xor, body.encode()) != int(told, 16):
            self.counts.bad_checksum += 1
            return []
        self.counts.frames += 1
        return [RadioReading(tag, range_m=int(range_mm) / 1000.0)]


ACME = RadioKind(
    name="acme",
    decoder=AcmeDecoder,
    title="Acme Pinger",
    gives="range",
    emitter="an Acme tag",
    transport="serial:115200",
    defaults={"range_sigma_m": 0.5},
)
''',
        ),
    ),
    2: (
        Edit(
            "companion/radios/decoder.py",
            '    "acme": "companion.radios.acme:ACME",\n',
            r"^BUILT_IN: .* = \{\n",
        ),
    ),
    3: (
        Edit(
            "tests/unit/companion/radios/test_acme.py",
            """from __future__ import annotations

import pytest

from companion.radios.acme import AcmeDecoder


@pytest.mark.parametrize(("line", "ranges_m"), [("$ACM,7,12345*49", [12.345]), ("$ACM,7*00", [])])
def test_a_line_of_the_manual_is_a_range(line: str, ranges_m: list[float]) -> None:
    found = AcmeDecoder().feed(f"{line}\\r\\n".encode(), 0.0)
    assert [reading.range_m for reading in found] == ranges_m
""",
        ),
    ),
    4: (
        Edit(
            "tests/data/radios/acme.bin",
            "$ACM,7,12345*49\r\n$ACM,8,980*46\r\n$ACM,7,12001*4A\r\n",
        ),
        Edit("tests/contract/radio_streams.py", '"acme", ', r"^CHECKSUMMED = \{"),
        Command(
            ("-m", "tests.contract.radio_streams", "acme"), makes="tests/data/radios/acme.jsonl"
        ),
    ),
    5: (
        Edit(
            "sim_link/emulators/acme.py",
            '''"""Acme's radio. Source: its manual, section "Output"."""

from __future__ import annotations

from sim_link.emulators.emulator import Answer, Emulator, Round, clamped, lines


class Acme(Emulator):
    """A line for each tag that answered."""

    name = "acme"
    title = "Acme Pinger"

    def encode(self, asked: Round) -> bytes:
        """In millimetres."""
        return lines([self._line(each) for each in asked.heard if each.range_m is not None])

    def _line(self, answer: Answer) -> str:
        range_mm = clamped(1000.0 * (answer.range_m or 0.0), 0, 9_999_999)
        body, check = f"ACM,{answer.emitter_id},{range_mm}", 0
        for byte in body.encode():
            check ^= byte
        return f"${body}*{check:02X}"
''',
        ),
        Edit(
            "sim_link/emulators/catalogue.py",
            "from sim_link.emulators import acme as acme_radio\n",
            r"^from companion.errors import .*\n",
        ),
        Edit("sim_link/emulators/catalogue.py", "    acme_radio.Acme,\n", r"^KINDS: .*= \(\n"),
        Edit("tests/radio_formats.py", '    Format("acme", "acme", 0.5e-3),\n', r"^FORMATS = \(\n"),
    ),
    6: (
        Edit(
            "configs/radios/acme.yaml",
            "# Acme Pinger: ranges alone.\n\nradios:\n  - name: acme\n"
            "    url: serial:/dev/ttyUSB0:115200\n    settings:\n      range_offset_m: 0.0\n",
        ),
        Edit(
            "docs/radios.md",
            "| an Acme tag | [Acme](radios/uwb.md#acme) | `acme` | I | `phone_ftm` |\n",
            r"^\| a LoRa module .*\n",
        ),
        Edit("docs/radios/uwb.md", "\n## Acme\n\nPlug it in.\n"),
    ),
}

FAILSAFE: Steps = {
    1: (
        Edit(
            "companion/guidance/control_authority.py",
            '    VIBRATION = "strong vibration"\n',
            r"^    NO_FIX = .*\n",
        ),
    ),
    2: (
        Edit(
            "companion/guidance/health/vibration.py",
            '''"""Vibration that leaves the autopilot's estimate in doubt.

Source: ArduPilot, "Measuring Vibration": above 30 m/s^2 there is trouble.
"""

from __future__ import annotations

from companion.guidance import events
from companion.guidance.control_authority import Finding, Reason, Verdict, Watch

STRONG_MPS2 = 30.0


class VibrationWatch(Watch):
    """Holds while the last report is strong."""

    def __init__(self) -> None:
        self._is_strong = False

    def handle(self, event: events.Event) -> None:
        """Take in a report."""
        if isinstance(event, events.VibrationReported):
            self._is_strong = event.worst_mps2 > STRONG_MPS2

    def step(self, now_s: float) -> Finding | None:
        """Hold."""
        del now_s
        if not self._is_strong:
            return None
        return Finding(Verdict.HOLD, Reason.VIBRATION, "strong vibration")
''',
        ),
    ),
    3: (
        Edit(
            "companion/guidance/health/watches.py",
            "from companion.guidance.health.vibration import VibrationWatch\n",
            r"^from companion.guidance.health.position_jumps import .*\n",
        ),
        Edit(
            "companion/guidance/health/watches.py",
            "            VibrationWatch(),\n",
            r"^        self._for_launch = \(\n",
        ),
    ),
    4: (
        Edit(
            "companion/guidance/events.py",
            '''@dataclass(frozen=True, slots=True)
class VibrationReported(Event):
    """How much the airframe shakes."""

    worst_mps2: float


''',
            r"^class FixReported\(Event\):\n(.*\n)+?\n\n",
        ),
        Edit(
            "companion/link/conversion/health_reports.py",
            "    VibrationReported,\n",
            r"^    RcStatusReported,\n",
        ),
        Edit(
            "companion/link/conversion/health_reports.py",
            "        others = [*_place_rated(message, now_s), *_vibration(message, now_s)]\n"
            "        return [*([] if event is None else [event]), *others]\n",
            r"^        return \[.*\*_place_rated\(message, now_s\)\]\n",
            is_instead=True,
        ),
        Edit(
            "companion/link/conversion/health_reports.py",
            '''

def _vibration(message: Message, now_s: float) -> list[Event]:
    """How much the airframe shakes, where the message reports that."""
    if not isinstance(message, mavlink.MAVLink_vibration_message):
        return []
    worst = max(message.vibration_x, message.vibration_y, message.vibration_z)
    return [VibrationReported(now_s, worst)]
''',
        ),
        Edit(
            "companion/link/inbound.py",
            "",
            r"^        mavlink.MAVLINK_MSG_ID_VIBRATION,\n",
            is_instead=True,
        ),
    ),
    5: (
        Edit(
            "tests/unit/companion/guidance/health/test_vibration.py",
            """from __future__ import annotations

from companion.guidance.events import VibrationReported
from companion.guidance.control_authority import Verdict
from companion.guidance.health.vibration import VibrationWatch


def test_it_holds_while_it_shakes() -> None:
    watch = VibrationWatch()
    verdicts = []
    for time_s, worst_mps2 in enumerate((10.0, 31.0, 29.0)):
        watch.handle(VibrationReported(float(time_s), worst_mps2))
        found = watch.step(float(time_s))
        verdicts.append(found and found.verdict)
    assert verdicts == [None, Verdict.HOLD, None]
""",
        ),
        Edit(
            "tests/loop/test_authority.py",
            """

def test_strong_vibration_is_held_on() -> None:
    loop = flying()
    shakes = mavlink.MAVLink_vibration_message(0, 60.0, 1.0, 1.0, 0, 0, 0)
    loop.flight.attack(Chunk(0, MavCodec(1, 1).encode(shakes), VEHICLE_PEER))
    loop.run(1.0)
    assert "strong vibration" in reasons(loop)
    assert loop.phase is Phase.HOLD
""",
        ),
    ),
    6: (
        Edit(
            "docs/safety.md",
            "| above 30 m/s2 | `strong vibration` | holds | land, and balance the propellers |\n",
            r"^\| .* \| `autopilot lost GNSS fix` .*\n",
        ),
        Edit(
            "tests/hazards.yaml",
            'A15: {hazard: "Strong vibration", '
            'test: "tests/loop/test_authority.py::test_strong_vibration_is_held_on"}\n',
            r"^A14: .*\n",
        ),
    ),
}

RULE: Steps = {
    1: (
        Edit(
            "sim_link/lab/conformance/vehicle_rules/telemetry_rules.py",
            '''
    @book.rule("MAVLink common, SYS_STATUS.load")
    def load_is_a_share(self) -> None:
        """SYS_STATUS.load is at most 1000, in tenths of a percent."""
        self.set_interval(mavlink.MAVLink_sys_status_message, 0.2)
        self.run(2.0)
        told = [e.message for e in self.inbox if e.message.get_type() == "SYS_STATUS"]
        require(bool(told), "SYS_STATUS did not come")
        require(max(vars(each)["load"] for each in told) <= 1000, "more than all")
''',
            r"^class TelemetryRules(.*\n)+?    book = .*\n",
        ),
    ),
    2: (),
    3: (
        Edit(
            "tests/protocol/test_conformance_suite.py",
            '    "load_is_a_share broken": '
            '("telemetry.load_is_a_share", PX4, unchanged, set_byte(1, 13, 255)),\n',
            r"^DEFECTS: .* = \{\n",
        ),
    ),
}

STEP: Steps = {
    1: (
        Edit(
            "sim_link/lab/mission/script.py",
            '''class StandStep(StepParams, frozen=True):
    """Wait until the vehicle stands, disarmed, whoever lands it."""

    limit_s: Limit = 60.0


''',
            r"^class LandStep\((.*\n)+?\n\n",
        ),
        Edit(
            "sim_link/lab/mission/script.py",
            '"stand", ',
            r"^StepWord = Literal\[(.*\n)+?    (?=\"hold\")",
        ),
        Edit(
            "sim_link/lab/mission/script.py",
            "    stand: StandStep | UnsetType | None = UNSET\n",
            r"^    land: LandStep .*\n",
        ),
    ),
    2: (
        Edit(
            "sim_link/lab/mission/steps.py",
            '    script.StandStep: StepRule("standing, disarmed", DISARMED),\n',
            r"^FIXED_RULES: .* = \{\n",
        ),
    ),
    3: (
        Edit(
            "docs/missions.md",
            "| `stand` | Wait until the vehicle stands, disarmed. | `limit_s` (60.0) |\n",
            r"^\| `land` .*\n",
        ),
    ),
}


@dataclass(frozen=True, slots=True)
class Recipe:
    """A recipe of the page, and how it is followed."""

    heading: str
    name: str
    """What `NAME` stands for; the tests that run must speak of it."""
    steps: Steps
    mentions: frozenset[str] = frozenset()
    """Files that its steps name to be read, or for cases that the specimen is not."""


RECIPES = (
    Recipe("A filter", "gated", FILTER),
    Recipe("A planner, or a search pattern", "orbit", PLANNER),
    Recipe("A radio", "acme", RADIO),
    Recipe(
        "A failsafe",
        "vibration",
        FAILSAFE,
        frozenset({"companion/guidance/health/autopilot_health.py"}),
    ),
    Recipe(
        "A MAVLink rule",
        "load_is_a_share",
        RULE,
        frozenset(
            {
                "sim_link/lab/conformance/companion_rules.py",
                "sim_link/lab/conformance/autopilot_notes.yaml",
                "docs/conformance.md",
            }
        ),
    ),
    Recipe("A step of missions", "stand", STEP),
)
