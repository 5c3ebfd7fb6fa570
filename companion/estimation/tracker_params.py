"""Parameters of a tracker: those that a file configures, and those that only studies vary."""

from __future__ import annotations

import msgspec

from companion.domain import Distance, Params, Positive
from companion.estimation.filters.kalman import FilterKind
from companion.estimation.filters.target_filter import FilterConfig, FilterParams
from companion.estimation.innovations import GATE_SIGMAS
from companion.estimation.screen import AcceptanceParams
from companion.estimation.window.window_map import WindowParams


class EstimationConfig(Params, frozen=True):
    """Estimation of one target as a file configures it; `TrackerParams` completes it."""

    kind: FilterKind = "asymmetric_huber"
    """The recursive filter; the others are baselines."""
    filter: FilterConfig = FilterConfig()
    localised_r95_m: Distance = 2.0
    """Largest R95 at which the state is `localised`."""

    def params(self) -> TrackerParams:
        """Return the parameters of a tracker with this configuration."""
        return TrackerParams(
            kind=self.kind, filter=self.filter.params(), localised_r95_m=self.localised_r95_m
        )


class TrackerParams(EstimationConfig, frozen=True):
    """Parameters of a tracker: those of a file, and those that only studies vary."""

    filter: FilterParams = FilterParams()
    acceptance: AcceptanceParams = AcceptanceParams()
    window: WindowParams = WindowParams()
    is_range_calibrated: bool = True
    """False: the radio adds an unknown constant, so no position is `localised`."""
    initial_inflation: Positive = 4.0
    """Variance inflation that is assumed until it has been measured."""
    range_gross_k: Positive | None = GATE_SIGMAS
    """Ranges shorter than predicted by more than this many sigma have a linear loss even where
    `filter.range_k_short` is null: noise does not produce them; null: quadratic at any size."""
    adapt_inflation: bool = True
    """True: the inflation is measured; false: it stays at 1, as in the paper's filter."""

    def params(self) -> TrackerParams:
        """Return these parameters."""
        return self

    @property
    def with_power(self) -> TrackerParams:
        """The same parameters for an emitter that gives power alone; itself if configured."""
        return msgspec.structs.replace(self, filter=self.filter.with_power)

    @property
    def effective_filter(self) -> FilterParams:
        """Parameters of the tracker's filter: `filter` with ranges bounded on the short side."""
        if self.range_gross_k is None or self.filter.range_k_short is not None:
            return self.filter
        return msgspec.structs.replace(self.filter, range_k_short=self.range_gross_k)
