"""From ranging measurements to an honest estimate of one target.

`TargetTracker` is what the guidance session and the replay share: it refuses what is implausible
(counted, and without touching the filter), starts and runs the hypotheses, measures its own noise,
notices when it contradicts its measurements, and says where the target is, how wrong that may be,
and whether that is enough.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import msgspec

from companion.domain import Params, PositionEnu, Positive, RangingMeasurement, TargetEstimate
from companion.estimation.belief import Belief, belief_of, hypotheses_of
from companion.estimation.filter_bank import BankUpdate, estimate_of, update_hypotheses
from companion.estimation.filters.kalman import FilterKind, filter_of
from companion.estimation.filters.target_filter import (
    NO_INFLATION,
    FilterParams,
    Inflation,
    UpdateReport,
)
from companion.estimation.hypotheses import (
    Hypothesis,
    HypothesisParams,
    consolidated,
    first_hypotheses,
    shift_hypothesis,
    state_step,
)
from companion.estimation.integrity.target_motion import MotionWatch
from companion.estimation.integrity.track_integrity import (
    CONTRADICTION_COUNT,
    Contact,
    TrackIntegrity,
)
from companion.estimation.measurement_model import target_height_m
from companion.estimation.noise.adaptation import AdaptationParams
from companion.estimation.noise.innovations import InnovationNoise, NoiseLearner, TrackerHealth
from companion.estimation.screening.plausibility import Plausibility
from companion.estimation.screening.validation import (
    AcceptanceParams,
    Gate,
    Objection,
    RejectReason,
    identity_of,
    reject_reason_of,
)
from companion.estimation.window.optimizer import WindowOptimizer
from companion.estimation.window.sandwich import Observability
from companion.estimation.window.window_map import WindowParams
from companion.kernel import Vector


class TrackerParams(Params, frozen=True):
    """Everything about the estimate of one target."""

    kind: FilterKind = "asymmetric_huber"
    """The recursive filter; the others are baselines."""
    filter: FilterParams = FilterParams()
    acceptance: AcceptanceParams = AcceptanceParams()
    hypotheses: HypothesisParams = HypothesisParams()
    window: WindowParams = WindowParams()
    localised_r95_m: Positive = 2.0
    """The state is `localised` while R95 is at most this."""
    initial_inflation: Positive = 4.0
    """Variance inflation taken for granted until the run has shown its own."""
    adaptation: AdaptationParams | None = None
    """Whether and how noise and thresholds are learnt on the run; null: they stay as configured."""
    range_gross_k: Positive | None = 6.0
    """Ranges shorter than expected by more than this many sigma count linearly even where
    `filter.range_k_short` is null: no noise makes them; null: quadratic at any size."""
    adapt_inflation: bool = True
    """Whether the inflation is measured; false keeps it at 1, as the paper's filter has it."""

    @property
    def believed(self) -> FilterParams:
        """What the tracker's filter believes: `filter`, ranges bounded on the short side."""
        if self.range_gross_k is None or self.filter.range_k_short is not None:
            return self.filter
        return msgspec.structs.replace(self.filter, range_k_short=self.range_gross_k)


@dataclass(frozen=True, slots=True)
class FusionReport:
    """What became of one measurement."""

    refusal: RejectReason | None
    update: UpdateReport | None = None
    """The best hypothesis' update; None for a refusal and for the first measurement."""
    restarted: bool = False
    """The filter lost its covariance or contradicted its measurements, and was started anew."""
    agrees: bool = True
    """Whether all that was measured agrees with the estimate."""
    measurement: RangingMeasurement | None = None
    """What was measured, its bearing in the local frame, where the log is to tell it."""
    sensor_enu_m: PositionEnu | None = None
    """Where it was measured."""


DUPLICATE_MEMORY = 256
Row = tuple[PositionEnu, Vector, Vector]
"""Where a measurement was made, its values (3,) and their sigmas (3,)."""


class TargetTracker:
    """Tracks one emitter.

    Args:
        emitter_id: The emitter to follow; None: the first one heard.
    """

    def __init__(self, params: TrackerParams, emitter_id: int | None = None) -> None:
        self.params = params
        self.emitter_id = emitter_id
        self.refusals: Counter[RejectReason] = Counter()
        self.accepted = 0
        self.restarts = 0
        self.last_accepted_s: float | None = None
        self._standing = TrackIntegrity()
        self._plausibility = Plausibility(params.filter, params.acceptance.max_range_m)
        self._believed = params.believed
        self._filter = filter_of(params.kind, self._believed)
        self._thresholds = self._filter.params.thresholds
        self._polisher = WindowOptimizer(self._filter.params, params.window)
        self._recent: dict[Hashable, None] = {}
        """What the last accepted measurements were, oldest first."""
        self._hypotheses: tuple[Hypothesis, ...] = ()
        self._noise = self._fresh_noise()
        self._learner = self._fresh_learner()
        self._latest: deque[Row] = deque(maxlen=CONTRADICTION_COUNT)
        self._watch = MotionWatch(params.filter, params.localised_r95_m)
        self._diverged_until = 0
        self._is_borne_from_heading = False
        """Whether the newest bearing came relative to the vehicle's heading."""

    def fuse(
        self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu | None, now_s: float
    ) -> FusionReport:
        """Take in one measurement.

        Args:
            measurement: Its bearing, if any, in ENU.
            sensor_enu_m: Where the antenna was at the time of the measurement; None: unknown.
        """
        refusal = self._refusal_of(measurement, sensor_enu_m, now_s)
        if refusal is not None or sensor_enu_m is None:
            self._plausibility.refused(refusal or RejectReason.NO_POSITION, now_s)
            return self.refuse(refusal or RejectReason.NO_POSITION)
        if self.emitter_id is None:
            self.emitter_id = measurement.emitter_id
        self._recent[identity_of(measurement)] = None
        if len(self._recent) > DUPLICATE_MEMORY:
            del self._recent[next(iter(self._recent))]
        report = self._judged(measurement, sensor_enu_m, now_s)
        if report.refusal is not None:
            return self.refuse(report.refusal)
        self.accepted += 1
        self.last_accepted_s = now_s
        if report.update is not None:
            self._learn(report.update)
        if self._hypotheses and self._polisher.is_due(self.accepted):
            self.polish()
        self._look_for_motion(measurement.measured_at_s)
        return report

    def refuse(self, reason: RejectReason) -> FusionReport:
        """Count a measurement that the caller could not even offer."""
        self.refusals[reason] += 1
        return FusionReport(reason)

    def restart(self) -> None:
        """Forget the target but not the emitter, because the frame may have moved."""
        self._forget_place()
        self._plausibility.clear()
        self.last_accepted_s = None
        self._recent.clear()

    def move(self, shift_enu_m: PositionEnu, turn_rad: float) -> None:
        """The vehicle's navigation jumped: what is known moves along, see `moving`.

        Args:
            shift_enu_m: By how much its reported position jumped.
            turn_rad: By how much bearings turn that are measured from its heading,
                counter-clockwise; of a radio that knows north itself they do not.
        """
        turn_rad = turn_rad if self._is_borne_from_heading else 0.0
        step = state_step(self._filter.params, shift_enu_m, turn_rad)
        self._hypotheses = tuple(shift_hypothesis(h, step) for h in self._hypotheses)
        self._polisher.move(shift_enu_m, step)
        self._watch.move(shift_enu_m, step, self._filter.params)
        self._latest.clear()
        self._plausibility.jumped()

    def _forget_place(self) -> None:
        self._hypotheses = ()
        self._noise = self._fresh_noise()
        self._standing.forget()
        self._latest.clear()
        self._watch.clear()
        self._polisher.clear()

    @property
    def belief(self) -> Belief | None:
        """What would be worth knowing after a restart; None before the first measurement."""
        return belief_of(self._hypotheses, self.emitter_id, self.accepted)

    def resume(self, belief: Belief, age_s: float, now_s: float) -> str | None:
        """Begin again from what was believed `age_s` ago, with doubt; see `belief`.

        Returns:
            Why not, in words; the tracker is as before then.
        """
        problem = belief.problem(len(self._filter.params.prior[0]))
        if problem is not None:
            return problem
        if self.emitter_id not in (None, belief.emitter_id):
            return "another emitter"
        self.restart()
        self.emitter_id = belief.emitter_id
        self._hypotheses = hypotheses_of(belief, age_s, now_s, self._filter.params)
        if len(self._hypotheses) == 1:
            self._polisher.begin_from(self._hypotheses[0])
        return None

    def estimate(self, now_s: float) -> TargetEstimate | None:
        """Where the target is believed to be, or None before the first measurement."""
        if not self._hypotheses:
            return None
        return estimate_of(
            self._hypotheses,
            self._filter.params.model,
            self.params.localised_r95_m,
            self.accepted,
            now_s,
            is_diverged=self.accepted < self._diverged_until,
        )

    def objection(self, now_s: float) -> Objection | None:
        """Why the estimate must not be flown on, although there is one; None: it may."""
        objection = self._plausibility.objection or self._standing.objection(now_s)
        if objection is None and self._hypotheses and self.accepted < self._diverged_until:
            return Objection.RECOVERING
        return objection

    @property
    def contact(self) -> Contact:
        """How old each kind of measurement is, and how many agreed since the last gap."""
        return self._standing.contact

    @property
    def hypotheses(self) -> Sequence[Hypothesis]:
        """The places the target may be, best first."""
        return self._hypotheses

    @property
    def inflation(self) -> Inflation:
        """Variance inflation of range, bearing and elevation that the filter is told now."""
        return self._shown_inflation if self.params.adapt_inflation else NO_INFLATION

    @property
    def _shown_inflation(self) -> Inflation:
        """The one that the run has shown, by which measurements are judged.

        A filter that is told none believes in thermal noise among reflections, so that innovations
        are always larger than it says: that is no fault of measurement or estimate.
        """
        return self._noise.inflation(self._polisher.noise)

    @property
    def noise_believed(self) -> FilterParams:
        """Noise, thresholds, priors and bounds now in force, learnt ones included."""
        return self._filter.params

    @property
    def is_white(self) -> bool:
        """Whether innovations know nothing of each other, as far as can be told."""
        return self._noise.is_white

    @property
    def observability(self) -> Observability | None:
        """Curvature and bilateral information about the best hypothesis."""
        if not self._hypotheses:
            return None
        return self._polisher.observability(self._hypotheses[0].state.mean)

    def baseline_m(self, sensor_up_m: float) -> float:
        """How far to the side of the target a view from this height must be to say much."""
        if self._polisher.has_bearings or not self._hypotheses:
            return 0.0
        return abs(
            sensor_up_m - target_height_m(self._hypotheses[0].state.mean, self._filter.params.model)
        )

    @property
    def health(self) -> TrackerHealth:
        """How far the estimate can be trusted, as live values."""
        return self._noise.health(self.inflation, self.observability)

    @property
    def watch(self) -> MotionWatch:
        """Whether the target seems to walk although it is believed to lie still."""
        return self._watch

    @property
    def nlos_share(self) -> float:
        """Share of recent ranges on the linear branch of the loss: taken for reflections."""
        return self._noise.nlos_share

    def _refusal_of(
        self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu | None, now_s: float
    ) -> RejectReason | None:
        if self.emitter_id is not None and measurement.emitter_id != self.emitter_id:
            return RejectReason.OTHER_EMITTER
        refusal = reject_reason_of(measurement, now_s, self.params.acceptance)
        if refusal is not None:
            return refusal
        if identity_of(measurement) in self._recent:
            return RejectReason.DUPLICATE
        if sensor_enu_m is None or not all(math.isfinite(v) for v in sensor_enu_m):
            return RejectReason.NO_POSITION
        if measurement.range_m is None and measurement.bearing_enu_rad is None:
            return RejectReason.NO_YAW
        return None

    def _fresh_noise(self) -> InnovationNoise:
        return InnovationNoise.starting(self.params.initial_inflation)

    def _fresh_learner(self) -> NoiseLearner | None:
        adaptation = self.params.adaptation
        if adaptation is None:
            return None
        return NoiseLearner.starting(self._believed, adaptation)

    def _learn(self, report: UpdateReport) -> None:
        """Learn the noise, and tune the filter to it now and then."""
        if self._learner is None:
            return
        learner = self._learner.after(report)
        if learner.is_due and learner.count > self._learner.count:
            tuned = learner.tuned(self._believed)
            self._filter = filter_of(self.params.kind, tuned)
            self._thresholds = self._filter.params.thresholds
            self._polisher.retune(self._filter.params)
        self._learner = learner

    def _judged(
        self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu, now_s: float
    ) -> FusionReport:
        """Fuse what is plausible of a measurement."""
        was_plausible = self._plausibility.objection is None
        judgement = self._plausibility.judge(measurement, sensor_enu_m, now_s)
        if was_plausible and self._plausibility.objection and not self._standing.is_proven:
            self._forget_place()  # it was made from the very values that are condemned now
        passed = judgement.passed
        if passed is None:
            return FusionReport(judgement.reason)
        if passed.bearing_enu_rad is not None:
            self._is_borne_from_heading = passed.bearing_body_rad is not None
        if judgement.reason is not None:
            self.refusals[judgement.reason] += 1
        return self._fused(passed, sensor_enu_m)

    def _fused(self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu) -> FusionReport:
        if not self._hypotheses:
            self._add_to_window(self._note(measurement, sensor_enu_m))
            self._start(measurement, sensor_enu_m)
            self._standing.began(measurement)
            return FusionReport(None)
        bank = self._updated(measurement, sensor_enu_m)
        gate = bank.gate if self._standing.is_proven else bank.gate.unarmed()
        row = self._note(measurement, sensor_enu_m)
        if bank.best is None or self._standing.note(
            measurement, bank.best, gate, self._shown_inflation
        ):
            return self._restart(measurement, sensor_enu_m)
        passed = gate.passed(measurement)
        if not gate.is_open:
            self._count_outliers(gate, passed)
            if passed is None:
                return FusionReport(gate.refusal)
            bank = self._updated(passed, sensor_enu_m)
        if passed is None or bank.best is None:
            return self._restart(measurement, sensor_enu_m)
        self._add_to_window(row if gate.is_open else self._row(passed, sensor_enu_m))
        several = len(bank.hypotheses) > 1
        self._hypotheses = consolidated(bank.hypotheses) if several else bank.hypotheses
        self._noise = self._noise.after(bank.best, self._thresholds)
        return FusionReport(None, bank.best, agrees=gate.agrees)

    def _updated(self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu) -> BankUpdate:
        shown = self._shown_inflation
        told = shown if self.params.adapt_inflation else NO_INFLATION
        judging = self._standing.judging(shown)
        return update_hypotheses(
            self._hypotheses, self._filter, measurement, sensor_enu_m, told, judging
        )

    def _count_outliers(self, gate: Gate, passed: RangingMeasurement | None) -> None:
        """Count what was not fused of a measurement; one that is refused as a whole is one."""
        if passed is not None:
            self.refusals[gate.refusal] += 1

    def _row(self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu) -> Row:
        return (sensor_enu_m, *self._filter.params.seen(measurement))

    def _note(self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu) -> Row:
        row = self._row(measurement, sensor_enu_m)
        self._latest.append(row)
        self._watch.add(measurement.measured_at_s, *row)
        return row

    def _look_for_motion(self, now_s: float) -> None:
        """Look whether it walks although it is believed to lie still; the estimate stays."""
        estimate = self.estimate(now_s) if self._watch.is_due(now_s) else None
        if estimate is not None and self._watch.is_worth(estimate.r95_m):
            self._watch.look(self._polisher.map, self._hypotheses[0].state.mean)

    def _add_to_window(self, row: Row) -> None:
        self._polisher.add(*row, self._hypotheses, is_white=self.is_white)

    def _start(self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu) -> None:
        self._hypotheses = first_hypotheses(
            measurement, sensor_enu_m, self._believed, self.params.hypotheses
        )

    def polish(self, fresh_starts: int | None = None) -> None:
        """Check the hypotheses against the window, and let its optima correct them.

        Args:
            fresh_starts: How many starts besides the hypotheses; None: as many as the evidence
                calls for.
        """
        self._hypotheses = self._polisher.polished(
            self._hypotheses,
            self.accepted,
            self._shown_inflation,
            is_white=self.is_white,
            fresh_starts=fresh_starts,
        )

    def polish_thoroughly(self) -> None:
        """The same from every direction, for use after the last measurement of a recording."""
        self.polish(self.params.window.starts)

    def _restart(self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu) -> FusionReport:
        """Give the estimate up, and start from what was measured last, outliers included."""
        self.restarts += 1
        self._standing.given_up(measurement.measured_at_s)
        self._diverged_until = self.accepted + 1 + CONTRADICTION_COUNT
        self._noise = self._fresh_noise()
        self._polisher.begin_with(self._latest)
        self._start(measurement, sensor_enu_m)
        return FusionReport(None, None, restarted=True)
