"""Tracker of one target: from ranging measurements to a consistent estimate.

The guidance session and the replay share `TargetTracker`. It coordinates its parts: the screen
rejects implausible measurements (counted, and without touching the filter), the bank runs the
filter over the hypotheses, the optimizer corrects these by a window of measurements, the noise
monitor measures how far innovations exceed thermal noise, and track integrity checks whether
measurements and estimate agree.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from functools import partial

from companion.domain import (
    DEFAULT_ACCURACY,
    PositionAccuracy,
    PositionEnu,
    RangingMeasurement,
    TargetEstimate,
)
from companion.estimation.belief import Belief, belief_of, hypotheses_of
from companion.estimation.filters.kalman import filter_of
from companion.estimation.filters.target_filter import NO_INFLATION, Inflation, UpdateReport
from companion.estimation.hypotheses import (
    Hypothesis,
    consolidated,
    first_hypotheses,
    ranked,
    shift_hypothesis,
    state_step,
)
from companion.estimation.innovations import (
    OPEN,
    InnovationNoise,
    TrackerHealth,
    update_hypotheses,
)
from companion.estimation.integrity import ReportedSigmas, TrackIntegrity
from companion.estimation.measurement_model import AZIMUTH, rows_of, target_height_m
from companion.estimation.screen import MeasurementScreen, Objection, RejectReason
from companion.estimation.stepwise import Steps, Stepwise, finish, passes, while_same
from companion.estimation.target_estimate import (
    KeptEstimate,
    budget_of,
    estimate_of,
)
from companion.estimation.target_motion import EVERY_S, MotionWatch
from companion.estimation.tracker_params import TrackerParams
from companion.estimation.window.antenna_check import AntennaCheck
from companion.estimation.window.optimizer import SHARED_PASSES, WindowOptimizer
from companion.estimation.window.shared_errors import NO_ERRORS, shared_sigmas
from companion.kernel import Matrix
from companion.search.searched_area import SearchPrior


@dataclass(frozen=True, slots=True)
class FusionReport:
    """Result of one measurement."""

    reject_reason: RejectReason | None
    update: UpdateReport | None = None
    """Update of the best hypothesis; None if rejected, and for the first measurement."""
    restarted: bool = False
    """True if the filter lost its covariance or contradicted its measurements, and was reset."""
    agrees: bool = True
    """True if every measured component agrees with the estimate."""
    measurement: RangingMeasurement | None = None
    """The measurement, its bearing in the local frame, where it is to be logged."""
    sensor_enu_m: PositionEnu | None = None

    def of(self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu | None) -> FusionReport:
        """Return the same result with the measurement and the position it was seen from."""
        result = self.reject_reason, self.update, self.restarted, self.agrees
        return FusionReport(*result, measurement, sensor_enu_m)


class TargetTracker:
    """Tracker of one emitter: `emitter_id`, or the first one received."""

    def __init__(self, params: TrackerParams, emitter_id: int | None = None) -> None:
        self.emitter_id = emitter_id
        self.accepted = 0
        self.last_accepted_s: float | None = None
        self.hypotheses: tuple[Hypothesis, ...] = ()
        """Possible positions of the target, best first."""
        self.own: PositionAccuracy | None = None
        """Worst accuracy of the vehicle position during these measurements: GNSS errors persist for
        minutes, so that a better fix does not correct what was measured with a worse one."""
        self._best_own_m = math.inf
        """Best reported accuracy: a fix of another quality has another error."""
        self.raised_m = 0.0
        """Sum of the height steps of the vehicle's navigation since the track began: heights in the
        tracker keep the first zero, about which a configured target height is valid."""
        self.integrity = TrackIntegrity()
        self._screen = MeasurementScreen(params.filter, params.acceptance)
        self._reported_sigmas = ReportedSigmas()
        self._shared = NO_ERRORS
        self._kept_estimate = KeptEstimate()
        self.prior: SearchPrior | None = None
        """Probability map that the search before the first contact left over the area; None:
        unknown."""
        self._moves = 0
        """Number of frame shifts and resets; steps that began before the latest are abandoned."""
        self._set_up(params)

    def _set_up(self, params: TrackerParams) -> None:
        """Build the parts that depend on the components of the state."""
        self.params = params
        self.watch = MotionWatch(params.filter, params.localised_r95_m)
        self.antenna: AntennaCheck | None = None
        """Identification of an antenna that is not configured; None if it is configured."""
        filter_params = params.effective_filter
        if params.filter.antenna.kind == "auto":
            self.antenna = AntennaCheck(filter_params)
            filter_params = self.antenna.params
        self._filter = filter_of(params.kind, filter_params)
        storage_params = None if self.antenna is None else self._filter.params
        self._optimizer = WindowOptimizer(self._filter.params, params.window, storage_params)
        rows = rows_of(self._filter.params.model)
        self._noise = self._first_noise = InnovationNoise.starting(params.initial_inflation, rows)

    @property
    def rejected(self) -> Counter[RejectReason]:
        """Counts of measurements, or components of them, that were not fused, by reason."""
        return self._screen.rejected

    def fuse(
        self,
        measurement: RangingMeasurement,
        sensor_enu_m: PositionEnu | None,
        now_s: float,
        own: PositionAccuracy | None = None,
    ) -> FusionReport:
        """Process one measurement at once; see `fusion`."""
        return finish(self.fusion(measurement, sensor_enu_m, now_s, own))

    def fusion(
        self,
        measurement: RangingMeasurement,
        sensor_enu_m: PositionEnu | None,
        now_s: float,
        own: PositionAccuracy | None = None,
    ) -> Steps[FusionReport]:
        """Process one measurement, its bearing in ENU, from the antenna's position (None: unknown).

        `own` is the accuracy of that position on the Earth; None: unknown.
        """
        if self.emitter_id not in (None, measurement.emitter_id):
            return self.reject(RejectReason.OTHER_EMITTER)
        if measurement.power_dbm is not None or self.raised_m != 0.0:
            measurement, sensor_enu_m = self._prepared(measurement, sensor_enu_m)
        reason = self._screen.admit(measurement, sensor_enu_m, now_s)
        if reason is not None or sensor_enu_m is None:
            return self.reject(reason or RejectReason.NO_POSITION)
        self.emitter_id = measurement.emitter_id
        judgement = self._screen.judge(measurement, sensor_enu_m, now_s)
        if judgement.is_newly_objected and not self.integrity.is_proven:
            self._forget_position()  # it was derived from the values that are rejected now
        if judgement.reason is not None:
            self.rejected[judgement.reason] += 1
        if judgement.passed is None:
            return FusionReport(judgement.reason)
        report = self._update(judgement.passed, sensor_enu_m)
        if report.reject_reason is not None:
            return report
        self.accepted += 1
        self.last_accepted_s = now_s
        self.own = self.own if own in (None, self.own) else own.or_worse(self.own)
        if own is not None and own.is_reported:
            self._best_own_m = min(self._best_own_m, own.horizontal_m)
        at_s = measurement.measured_at_s
        if self.accepted >= self._optimizer.due_at or not at_s < self.watch.due_s <= at_s + EVERY_S:
            yield from self._check(at_s)
        return report

    def _check(self, at_s: float) -> Steps[None]:
        """Check the estimate by its window, and the target for motion, where that is due."""
        if self.hypotheses and self.accepted >= self._optimizer.due_at:
            yield 0
            yield from while_same(self.optimize.steps(), lambda: self._moves)
        estimate = self.estimate(at_s) if self.watch.is_due(at_s) else None
        if estimate is not None:
            mean = self.hypotheses[0].state.mean
            own, r95_m = self.own or DEFAULT_ACCURACY, estimate.r95_m
            look = self.watch.look.steps(self._optimizer.map, mean, r95_m, own, at_s)
            yield from while_same(look, lambda: self._moves)

    def _prepared(
        self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu | None
    ) -> tuple[RangingMeasurement, PositionEnu | None]:
        """Return the measurement with a power that can be used, and the position about kept zero.

        A power is used where its level is configured, or where an emitter gives nothing else.
        """
        if measurement.power_dbm is not None and self.params.filter.power_at_1m_dbm is None:
            if self.accepted or not measurement.is_power_alone:
                measurement = replace(measurement, power_dbm=None)
            else:
                self._set_up(self.params.with_power)
        if sensor_enu_m is not None:
            sensor_enu_m = (*sensor_enu_m[:2], sensor_enu_m[2] - self.raised_m)
        return measurement, sensor_enu_m

    def _update(self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu) -> FusionReport:
        """Fuse what passed the screen, unless the gate rejects it."""
        params, at_s = self._filter.params, measurement.measured_at_s
        storage, window = self._optimizer.storage_params, self._optimizer.window
        if self.antenna is not None:
            measurement = self._reported_sigmas.limited(measurement, params)
        row = storage.kernel_row(measurement, sensor_enu_m)
        self._optimizer.latest.append(row)
        seen = row if params is storage else params.kernel_row(measurement, sensor_enu_m)
        self.watch.fresh.append(seen)
        if not self.hypotheses:
            window.add(row, sensor_enu_m[:2], at_s)
            self._start(measurement, sensor_enu_m)
            self.integrity.begin(measurement)
            return FusionReport(None)
        integrity, measured = self.integrity, self._noise.inflation
        filter_inflation = measured if self.params.adapt_inflation else NO_INFLATION
        gate_inflation = integrity.gate_inflation(measured) if integrity.is_lost else measured
        inflations, is_proven = (filter_inflation, gate_inflation), integrity.is_proven
        bank = update_hypotheses(
            self.hypotheses, self._filter, measurement, sensor_enu_m, *inflations
        )
        gate = bank.gate if is_proven else bank.gate.unarmed()
        if not bank.reports or integrity.update(at_s, bank.reports[0], gate, gate_inflation):
            return self._restart(measurement, sensor_enu_m)
        passed = measurement if gate == OPEN else gate.passed(measurement)
        if passed is not measurement:
            self.rejected[gate.reject_reason] += 1
            if passed is None:
                return FusionReport(gate.reject_reason)
            bank = update_hypotheses(
                self.hypotheses, self._filter, passed, sensor_enu_m, *inflations
            )
            if not bank.reports:
                return self._restart(measurement, sensor_enu_m)
            row = storage.kernel_row(passed, sensor_enu_m)
        mean, several = self.hypotheses[0].state.mean, len(bank.hypotheses) > 1
        dropped = window.add(row, (float(mean[0]), float(mean[1])), at_s)
        if len(dropped) and len(self.hypotheses) == 1 and self._noise.is_white:
            self._optimizer.keep_evidence(dropped, mean)
        self.hypotheses = consolidated(bank.hypotheses) if several else bank.hypotheses
        self._noise = self._noise.after(bank.reports[0], params.thresholds)
        return FusionReport(None, bank.reports[0], agrees=gate.agrees)

    def _start(self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu) -> None:
        self.hypotheses = ranked(
            first_hypotheses(measurement, sensor_enu_m, self.params.effective_filter),
            self.prior,
        )

    def _restart(self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu) -> FusionReport:
        """Discard the track, and reinitialise from the latest measurement, even an outlier."""
        self.integrity.give_up(measurement.measured_at_s, self.accepted)
        self._noise = self._first_noise
        self._optimizer.begin_with_latest()
        self._start(measurement, sensor_enu_m)
        return FusionReport(None, None, restarted=True)

    @Stepwise
    def optimize(self, fresh_starts: int | None = None) -> Steps[None]:
        """Check the hypotheses against the window, and replace them by its optima.

        `fresh_starts` is the number of starts besides them: `params.window.starts` covers every
        direction, and None leaves the number to the evidence. Without a hypothesis nothing is done.
        """
        if not self.hypotheses:
            return
        inflation = self._noise.inflation
        mean, rows = self.hypotheses[0].state.mean, self._optimizer.window.rows
        if self.antenna is not None and (yield from self.antenna.look.steps(rows, mean, inflation)):
            self._filter = filter_of(self.params.kind, self.antenna.params)
            self._optimizer.switch_antenna(self._filter.params)
            self.watch.clear()
            fresh_starts = self.params.window.starts
        self.hypotheses = yield from self._optimizer.optimize.steps(
            self.hypotheses,
            self.accepted,
            inflation,
            is_white=self._noise.is_white,
            fresh_starts=fresh_starts,
        )
        self._noise = replace(self._noise, found=self._optimizer.noise)
        self.hypotheses = ranked(self.hypotheses, self.prior)
        params, is_auto = self._filter.params, self.antenna is not None
        sigmas = shared_sigmas(params, self.own, self._best_own_m, is_auto=is_auto)
        self._shared = self._optimizer.shared(self.hypotheses[0], sigmas)
        yield passes(SHARED_PASSES, len(rows))
        is_configured_array = not is_auto and params.model.antenna != AZIMUTH
        if is_configured_array and len(self.hypotheses) == 1:
            state, optimizer = self.hypotheses[0].state, self._optimizer
            scores = optimizer.map.scores(optimizer.rows, state.mean)
            self.integrity.configured_antenna.look(scores, state.time_s)

    def reject(self, reason: RejectReason) -> FusionReport:
        """Count a measurement that is not fused, also one that the caller could not prepare."""
        self.rejected[reason] += 1
        return FusionReport(reason)

    def restart(self) -> None:
        """Forget the target but not the emitter, because the frame may have moved."""
        self._forget_position()
        self._screen.clear()
        self.last_accepted_s, self.raised_m = None, 0.0
        self.own, self._best_own_m = None, math.inf
        self.prior = None

    def _forget_position(self) -> None:
        self._moves += 1
        self.hypotheses, self._shared = (), NO_ERRORS
        self._noise = self._first_noise
        self.integrity.forget()
        self.watch.clear()
        self._optimizer.clear()

    def move(self, shift_enu_m: PositionEnu, turn_rad: float, sigma_m: float = 0.0) -> None:
        """Shift the whole state with a jump of the vehicle's navigation, see `hypotheses`.

        Bearings measured from the heading turn counter-clockwise; north-referenced ones do not. The
        shift is known to `sigma_m` per axis.
        """
        self._moves += 1
        turn_rad = turn_rad if self._screen.has_body_bearings else 0.0
        step = state_step(self._filter.params, shift_enu_m[:2], turn_rad)
        self.raised_m += shift_enu_m[2]
        self.hypotheses = tuple(shift_hypothesis(h, step, sigma_m) for h in self.hypotheses)
        self.prior = None if self.prior is None else self.prior.moved(shift_enu_m[:2])
        self._optimizer.move(shift_enu_m[:2], step)
        self.watch.move(shift_enu_m[:2], step, self._filter.params)
        self._screen.forget_motion()

    @property
    def target_height_m(self) -> float:
        """Configured height of the target about the vehicle's current zero, metres."""
        return self.params.filter.target_height_m + self.raised_m

    @property
    def belief(self) -> Belief | None:
        """Checkpoint for a restart; None before the first measurement."""
        return belief_of(self.hypotheses, self.emitter_id, self.accepted, self.own, self.raised_m)

    def resume(self, belief: Belief, age_s: float, now_s: float) -> str | None:
        """Restore a checkpoint with inflated covariances; return why if it cannot be used."""
        sizes = {len(stored.mean) for stored in belief.places}
        if sizes == {len(self.params.with_power.filter.prior[0])}:
            self._set_up(self.params.with_power)
        params = self._filter.params
        problem = belief.problem(len(params.prior[0]))
        if problem is not None:
            return problem
        if self.emitter_id not in (None, belief.emitter_id):
            return "another emitter"
        self.restart()
        self.emitter_id = belief.emitter_id
        self.own = belief.own or DEFAULT_ACCURACY
        self.raised_m = belief.raised_m
        self.hypotheses = hypotheses_of(belief, age_s, now_s, params)
        if len(self.hypotheses) == 1:
            self._optimizer.begin_from(self.hypotheses[0])
        return None

    def estimate(self, now_s: float) -> TargetEstimate | None:
        """Return the estimate of the target at this time; None before the first measurement."""
        if not self.hypotheses:
            return None
        own, is_diverged = self.own or DEFAULT_ACCURACY, self.integrity.is_recovering(self.accepted)
        made_of = self.hypotheses, self._shared, own, self._filter, self.accepted, is_diverged
        make = partial(
            estimate_of,
            self.hypotheses,
            self._filter.params.model,
            self.params.localised_r95_m if self.params.is_range_calibrated else 0.0,
            self.accepted,
            now_s,
            is_diverged=is_diverged,
            shared=self._shared._replace(own=own),
        )
        estimate = self._kept_estimate.get(make, *made_of)
        if self.raised_m == 0.0 and estimate.time_s == now_s:
            return estimate
        return replace(estimate, time_s=now_s, height_m=estimate.height_m + self.raised_m)

    def budget(self, now_s: float) -> dict[str, float]:
        """Return R95 in metres after each term that widens it; the last one is the absolute R95."""
        estimate = self.estimate(now_s)
        if estimate is None:
            return {}
        mean = self.hypotheses[0].state.mean
        widths = self._optimizer.widths(mean, is_white=self._noise.is_white)
        own_sigma_m = self._filter.params.model.own_sigma_m
        return budget_of(estimate, self.hypotheses[0], widths, self._shared, own_sigma_m)

    def objection(self, now_s: float) -> Objection | None:
        """Return the reason not to use the estimate for guidance; None if it may be used."""
        integrity = self.integrity
        if self._screen.objection is not None:
            return self._screen.objection
        if not (integrity.restarts or integrity.is_lost):
            return None
        objection = integrity.objection(now_s)
        if objection is None and self.hypotheses and integrity.is_recovering(self.accepted):
            return Objection.RECOVERING
        return objection

    def baseline_m(self, sensor_up_m: float) -> float:
        """Return the minimum horizontal baseline to the target for an informative range, metres."""
        if self._optimizer.window.has_bearings or not self.hypotheses:
            return 0.0
        mean = self.hypotheses[0].state.mean
        target_up_m = target_height_m(mean, self._filter.params.model) + self.raised_m
        return abs(sensor_up_m - target_up_m)

    @property
    def identified_antenna(self) -> str | None:
        """Antenna kind that bearings identify, `contradicted` for a configured one, or None."""
        if self.antenna is not None:
            return self.antenna.identified
        return "contradicted" if self.integrity.configured_antenna.is_contradicted else None

    @property
    def _filter_inflation(self) -> Inflation:
        return self._noise.inflation if self.params.adapt_inflation else NO_INFLATION

    @property
    def latest_sigmas(self) -> tuple[float, float, float] | None:
        """`WindowOptimizer.latest_sigmas`, with the measured inflation; None: nothing measured."""
        if not self._optimizer.latest or not self.hypotheses:
            return None
        return self._optimizer.latest_sigmas(self.hypotheses[0].state.mean, self._filter_inflation)

    def joint_covariance(self, sensor_enu_m: PositionEnu) -> Matrix | None:
        """Return `WindowOptimizer.joint_covariance` of the best hypothesis; None without one."""
        if not self.hypotheses:
            return None
        sensor_enu_m = (*sensor_enu_m[:2], sensor_enu_m[2] - self.raised_m)
        return self._optimizer.joint_covariance(self.hypotheses[0].state, sensor_enu_m)

    @property
    def health(self) -> TrackerHealth:
        """Live indicators of the trust in the estimate."""
        observability = None
        if self.hypotheses:
            observability = self._optimizer.observability(self.hypotheses[0].state.mean)
        return self._noise.health(self._filter_inflation, observability)
