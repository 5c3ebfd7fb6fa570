"""Specimens of a filter, a planner and a failsafe, as steps of their recipes."""

from __future__ import annotations

from tests.e2e.recipe_edits import Edit, Steps

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
        position = kept_inside(wanted, request.estimate.position_enu_m, request)
        waypoint = Waypoint(position, WaypointReason.INFORMATION, "around the estimate")
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
    position = (0.0, 0.0)
    for _ in range(5):
        plan = Orbit(OrbitParams()).plan(PlanRequest(position, seen), None)
        position = plan.waypoint.position_enu_m
    assert abs(math.dist(position, (40.0, 0.0)) - 15.0) < 1e-9
""",
        ),
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
            "        others = [*_position_accuracy(message, now_s), *_vibration(message, now_s)]\n"
            "        return [*([] if event is None else [event]), *others]\n",
            r"^        return \[.*\*_position_accuracy\(message, now_s\)\]\n",
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
