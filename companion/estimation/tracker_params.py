"""The configuration of a target's tracker."""

from __future__ import annotations

import msgspec

from companion.estimation.adaptation import AdaptationParams
from companion.estimation.filter_params import FilterParams
from companion.estimation.filters import FilterKind
from companion.estimation.hypotheses import HypothesisParams
from companion.estimation.refusal import AcceptanceParams
from companion.estimation.window_map import WindowParams
from companion.params import Params, Positive


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
