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
from dataclasses import dataclass, replace

import numpy as np

from companion.domain import (
    EstimateState,
    PositionEnu,
    RangingMeasurement,
    TargetEstimate,
)
from companion.estimation.asymmetric_huber_ekf import AsymmetricHuberEkf
from companion.estimation.base import FilterParams, ModalityReport, UpdateReport
from companion.estimation.consistency import (
    NoiseMonitor,
    r95_of_covariance_m,
    r95_of_mixture_m,
)
from companion.estimation.hypotheses import (
    Hypothesis,
    HypothesisParams,
    consolidated,
    first_hypotheses,
    probabilities,
)
from companion.estimation.losses import asymmetric_huber_loss, threshold
from companion.estimation.measurement_window import MeasurementWindow
from companion.estimation.polish import polished
from companion.estimation.refusal import AcceptanceParams, Refusal, refusal_of
from companion.estimation.window_map import (
    MIN_MEASUREMENTS,
    WindowMap,
    WindowParams,
)
from companion.params import Params, Positive

DUPLICATE_MEMORY = 256
AMBIGUOUS_PROBABILITY = 0.05
"""A second hypothesis with at least this probability makes the estimate ambiguous."""
MAX_AMBIGUOUS = 3
"""More distinct places than this is searching, not ambiguous."""
MAX_POLISHED = 4
"""Hypotheses that start a solution of the window each time."""
UNSETTLED_STARTS, SETTLED_STARTS = 4, 1
"""Fresh starts per solution, before and after there is one hypothesis and much evidence."""
SETTLED_COUNT = 300
CONTRADICTION_COUNT = 40
"""How many measurements in a row must contradict the estimate before it is given up."""
CONTRADICTION_U = 3.0
"""Whitened innovation that contradicts: a bearing off to the same side, a range too short."""


class TrackerParams(Params, frozen=True):
    """Everything about the estimate of one target."""

    filter: FilterParams = FilterParams()
    acceptance: AcceptanceParams = AcceptanceParams()
    hypotheses: HypothesisParams = HypothesisParams()
    window: WindowParams = WindowParams()
    localised_r95_m: Positive = 2.0
    """The state is `localised` while R95 is at most this."""
    initial_inflation: Positive = 4.0
    """Variance inflation taken for granted until the run has shown its own."""
    adapt_inflation: bool = True
    """Whether the inflation is measured; false keeps it at 1, as the paper's filter has it."""


@dataclass(frozen=True, slots=True)
class FusionReport:
    """What became of one measurement."""

    refusal: Refusal | None
    update: UpdateReport | None = None
    """The best hypothesis' update; None for a refusal and for the first measurement."""
    restarted: bool = False
    """The filter lost its covariance or contradicted its measurements, and was started anew."""


class TargetTracker:
    """Tracks one emitter.

    Args:
        params: Filter, plausibility and honesty.
        emitter_id: The emitter to follow; None: the first one heard.
    """

    def __init__(self, params: TrackerParams, emitter_id: int | None = None) -> None:
        self.params = params
        self.emitter_id = emitter_id
        self.refusals: Counter[Refusal] = Counter()
        self.accepted = 0
        self.restarts = 0
        self.last_accepted_s: float | None = None
        self._filter = AsymmetricHuberEkf(params.filter)
        self._window = MeasurementWindow(params.window.size)
        self._window_map = WindowMap(params.filter)
        self._turn = 0
        self._recent: deque[Hashable] = deque(maxlen=DUPLICATE_MEMORY)
        self._hypotheses: tuple[Hypothesis, ...] = ()
        self._noise = self._fresh_noise()
        self._contradictions = 0
        self._contradiction_sign = 0.0
        self._diverged_until = 0

    def fuse(
        self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu | None, now_s: float
    ) -> FusionReport:
        """Take in one measurement.

        Args:
            measurement: Its bearing, if any, in ENU.
            sensor_enu_m: Where the antenna was at the time of the measurement; None: unknown.
            now_s: The present.
        """
        refusal = self._refusal_of(measurement, sensor_enu_m, now_s)
        if refusal is not None or sensor_enu_m is None:
            return self.refuse(refusal or Refusal.NO_POSITION)
        if self.emitter_id is None:
            self.emitter_id = measurement.emitter_id
        if measurement.stamp_us is not None:
            self._recent.append(_identity(measurement))
        self.accepted += 1
        self.last_accepted_s = now_s
        self._window.add(
            sensor_enu_m,
            measurement.range_m,
            measurement.bearing_enu_rad,
            self._filter.range_sigma_m(measurement),
            self._filter.bearing_sigma_rad(measurement),
            _place(self._hypotheses[0]) if self._hypotheses else sensor_enu_m[:2],
        )
        if not self._hypotheses:
            self._start(measurement, sensor_enu_m)
            return FusionReport(None)
        report = self._update(measurement, sensor_enu_m)
        if self.params.window.enabled and self.accepted % self.params.window.every == 0:
            is_settled = len(self._hypotheses) == 1 and self.accepted > SETTLED_COUNT
            self.polish(SETTLED_STARTS if is_settled else UNSETTLED_STARTS)
        return report

    def refuse(self, reason: Refusal) -> FusionReport:
        """Count a measurement that the caller could not even offer."""
        self.refusals[reason] += 1
        return FusionReport(reason)

    def restart(self) -> None:
        """Forget the target but not the emitter, because the frame may have moved."""
        self._hypotheses = ()
        self._noise = self._fresh_noise()
        self._contradictions = 0
        self.last_accepted_s = None
        self._recent.clear()
        self._window.clear()

    def estimate(self, now_s: float) -> TargetEstimate | None:
        """Where the target is believed to be, or None before the first measurement."""
        if not self._hypotheses:
            return None
        weights = probabilities(self._hypotheses)
        best = self._hypotheses[0].state
        r95_m = self._r95_m(weights)
        state = self._state_of(weights, r95_m)
        alternative = None
        if state is EstimateState.AMBIGUOUS:
            alternative = _place(self._hypotheses[1])
        covariance = self._position_covariance(self._hypotheses[0])
        return TargetEstimate(
            time_s=now_s,
            state=state,
            position_enu_m=_place(self._hypotheses[0]),
            covariance_m2=(
                (float(covariance[0, 0]), float(covariance[0, 1])),
                (float(covariance[1, 0]), float(covariance[1, 1])),
            ),
            r95_m=r95_m,
            range_offset_m=float(best.mean[2]),
            bearing_offset_rad=float(best.mean[3]),
            measurements=self.accepted,
            alternative_enu_m=alternative,
        )

    @property
    def hypotheses(self) -> Sequence[Hypothesis]:
        """The places the target may be, best first."""
        return self._hypotheses

    @property
    def inflation(self) -> tuple[float, float]:
        """Variance inflation of range and bearing now in force."""
        if not self.params.adapt_inflation:
            return (1.0, 1.0)
        return (self._noise[0].inflation, self._noise[1].inflation)

    def baseline_m(self, sensor_up_m: float) -> float:
        """How far to the side of the target a view from this height must be to say much."""
        if self._window.has_bearings:
            return 0.0
        return abs(sensor_up_m - self.params.filter.target_height_m)

    @property
    def nlos_share(self) -> float:
        """Share of recent ranges on the linear branch of the loss: taken for reflections."""
        return 1.0 - self._noise[0].bilateral_share

    def _refusal_of(
        self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu | None, now_s: float
    ) -> Refusal | None:
        if self.emitter_id is not None and measurement.emitter_id != self.emitter_id:
            return Refusal.OTHER_EMITTER
        refusal = refusal_of(measurement, now_s, self.params.acceptance)
        if refusal is not None:
            return refusal
        if measurement.stamp_us is not None and _identity(measurement) in self._recent:
            return Refusal.DUPLICATE
        if sensor_enu_m is None or not all(math.isfinite(v) for v in sensor_enu_m):
            return Refusal.NO_POSITION
        if measurement.range_m is None and measurement.bearing_enu_rad is None:
            return Refusal.NO_YAW
        return None

    def _fresh_noise(self) -> tuple[NoiseMonitor, NoiseMonitor]:
        prior = NoiseMonitor.prior(self.params.initial_inflation)
        return (prior, prior)

    def _start(self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu) -> None:
        self._hypotheses = first_hypotheses(
            measurement, sensor_enu_m, self.params.filter, self.params.hypotheses
        )

    def _update(self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu) -> FusionReport:
        inflation = self.inflation
        updated: list[Hypothesis] = []
        best: UpdateReport | None = None
        for hypothesis in self._hypotheses:
            state = self._filter.predict(hypothesis.state, measurement.measured_at_s)
            report = self._filter.update(state, measurement, sensor_enu_m, inflation)
            if not report.is_positive_definite:
                continue
            best = best or report
            log_weight = hypothesis.log_weight + self._log_likelihood(report, inflation)
            updated.append(replace(hypothesis, log_weight=log_weight, state=report.state))
        if best is None:
            return self._restart(measurement, sensor_enu_m)
        self._hypotheses = consolidated(updated) if len(updated) > 1 else tuple(updated)
        self._observe_noise(best)
        self._count_contradictions(best)
        if self._contradictions >= CONTRADICTION_COUNT:
            return self._restart(measurement, sensor_enu_m)
        return FusionReport(None, best)

    def polish(self, fresh_starts: int | None = None) -> None:
        """Check the hypotheses against the window, and let its optima correct them.

        Args:
            fresh_starts: How many starts besides the hypotheses; None: all directions, for use
                after the last measurement of a recording.
        """
        if len(self._window) < MIN_MEASUREMENTS or not self._hypotheses:
            return
        rows, directions = self._window.rows, self.params.window.starts
        starts = [h.state.mean for h in self._hypotheses[:MAX_POLISHED]]
        for _ in range(directions if fresh_starts is None else fresh_starts):
            direction_rad = 2.0 * math.pi * self._turn / directions
            spread = self._turn // directions + self._turn
            starts.append(self._window_map.start_around(rows, direction_rad, spread))
            self._turn += 1
        optima = self._window_map.optima(rows, starts)
        is_white = all(monitor.correlation == 0.0 for monitor in self._noise)
        has_seen_more = not self._window.is_complete
        time_s = self._hypotheses[0].state.time_s
        self._hypotheses = polished(
            self._hypotheses, optima, time_s, keep_confirmed=is_white and has_seen_more
        )

    def _log_likelihood(self, report: UpdateReport, inflation: tuple[float, float]) -> float:
        """Robust log-likelihood of both innovations, tempered by the inflation."""
        p = self.params.filter
        total = 0.0
        rows = (
            (report.range, p.range_k_long, p.range_k_short, inflation[0]),
            (report.bearing, p.bearing_k, p.bearing_k, inflation[1]),
        )
        for row, k_long, k_short, c in rows:
            if row is None:
                continue
            spread2 = row.noise_sigma**2 * (1.0 + row.prior_share)
            u = row.innovation / math.sqrt(spread2)
            loss = asymmetric_huber_loss(u, threshold(k_long), threshold(k_short))
            total -= (loss + 0.5 * math.log(spread2)) / c
        return total

    def _observe_noise(self, report: UpdateReport) -> None:
        """Learn from innovations that are noise, not the state's own uncertainty."""
        p = self.params.filter
        range_noise = _observed(self._noise[0], report.range, p.range_k_long, p.range_k_short)
        bearing_noise = _observed(self._noise[1], report.bearing, p.bearing_k, p.bearing_k)
        self._noise = (range_noise, bearing_noise)

    def _count_contradictions(self, report: UpdateReport) -> None:
        """Count measurements in a row that a confident estimate cannot explain.

        Ranges that are too long say nothing: that is what reflections do.
        """
        sign = 0.0
        if report.bearing is not None and report.bearing.prior_share < 1.0:
            u = report.bearing.whitened_innovation / math.sqrt(self.inflation[1])
            is_behind = abs(report.bearing.innovation) > 0.5 * math.pi  # to neither side
            side = 3.0 if is_behind else math.copysign(1.0, u)
            sign = side if abs(u) > CONTRADICTION_U else 0.0
        if sign == 0.0 and report.range is not None and report.range.prior_share < 1.0:
            u = report.range.whitened_innovation / math.sqrt(self.inflation[0])
            sign = -2.0 if u < -CONTRADICTION_U else 0.0
        is_same = sign != 0.0 and sign == self._contradiction_sign
        self._contradictions = self._contradictions + 1 if is_same else int(sign != 0.0)
        self._contradiction_sign = sign

    def _restart(self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu) -> FusionReport:
        self.restarts += 1
        self._diverged_until = self.accepted + CONTRADICTION_COUNT
        self._contradictions = 0
        self._noise = self._fresh_noise()
        self._start(measurement, sensor_enu_m)
        return FusionReport(None, None, restarted=True)

    def _position_covariance(self, hypothesis: Hypothesis) -> np.ndarray:
        """The filter's covariance, or the window's if that is larger, plus the own position's.

        All measurements share the error of the own position. The filter's covariance is the smaller
        one where a track that sees the target from one side only repeats itself. What the window
        left out counts as if it were as good as what it kept, unless residuals are correlated.
        """
        covariance = hypothesis.state.covariance[:2, :2]
        if hypothesis.window_covariance is not None:
            is_white = all(monitor.correlation == 0.0 for monitor in self._noise)
            share = self._window.kept_share if is_white else 1.0
            window = share * hypothesis.window_covariance[:2, :2]
            if np.trace(window) > np.trace(covariance):
                covariance = window
        own = self.params.filter.own_position_sigma_m
        return covariance + own * own * np.eye(2)

    def _r95_m(self, weights: np.ndarray) -> float:
        if len(self._hypotheses) == 1:
            return r95_of_covariance_m(self._position_covariance(self._hypotheses[0]))
        components = [
            (float(weight), h.state.mean[:2], self._position_covariance(h))
            for weight, h in zip(weights, self._hypotheses, strict=True)
        ]
        return r95_of_mixture_m(self._hypotheses[0].state.mean[:2], components)

    def _state_of(self, weights: np.ndarray, r95_m: float) -> EstimateState:
        if self.accepted < self._diverged_until:
            return EstimateState.DIVERGED
        likely = int(np.sum(weights >= AMBIGUOUS_PROBABILITY))
        if 1 < likely <= MAX_AMBIGUOUS:
            return EstimateState.AMBIGUOUS
        if likely == 1 and r95_m <= self.params.localised_r95_m:
            return EstimateState.LOCALISED
        return EstimateState.SEARCHING


def _identity(measurement: RangingMeasurement) -> Hashable:
    """What two copies of one measurement share: the stamp alone is shared by range and bearing.

    Not the bearing that was turned from the body frame, because a copy may see a later yaw.
    """
    m = measurement
    bearing_rad = m.bearing_enu_rad if m.bearing_body_rad is None else m.bearing_body_rad
    return (m.stamp_us, m.range_m, bearing_rad)


def _place(hypothesis: Hypothesis) -> tuple[float, float]:
    return (float(hypothesis.state.mean[0]), float(hypothesis.state.mean[1]))


def _observed(
    monitor: NoiseMonitor,
    report: ModalityReport | None,
    k_long: float | None,
    k_short: float | None,
) -> NoiseMonitor:
    if report is None:
        return monitor
    if report.prior_share > 1.0:
        return monitor.reset_correlation()
    return monitor.after(report.whitened_innovation, threshold(k_long), threshold(k_short))
