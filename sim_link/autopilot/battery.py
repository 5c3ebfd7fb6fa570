"""The battery: a four-cell pack that only flying empties."""

from __future__ import annotations

from sim_link.autopilot.scenario import BatteryParams

FULL_CELL_MV, EMPTY_CELL_MV, CELLS = 4200, 3500, 4
HOVER_CURRENT_CA = 1800
IDLE_CURRENT_CA = 50


class Battery:
    """Charge, voltage and current.

    Args:
        params: Endurance, and charge at the start.
    """

    def __init__(self, params: BatteryParams) -> None:
        self._params = params
        self.share = params.start_share
        """Charge that is left, 0 to 1."""
        self.is_known = True
        """Whether the reports tell the charge."""
        self.current_ca = IDLE_CURRENT_CA
        """Hundredths of an ampere."""

    def step(self, is_flying: bool, dt_s: float) -> None:
        """Draw for `dt_s` seconds."""
        self.current_ca = HOVER_CURRENT_CA if is_flying else IDLE_CURRENT_CA
        if is_flying:
            self.share = max(0.0, self.share - dt_s / self._params.endurance_s)

    def set_charge(self, share: float | None) -> None:
        """Another charge, 0 to 1; None: nobody knows it any more."""
        self.is_known = share is not None
        if share is not None:
            self.share = share

    @property
    def percent(self) -> int:
        """Charge that is left, 0 to 100."""
        return max(0, round(100.0 * self.share))

    @property
    def cell_mv(self) -> int:
        """Voltage of one cell, millivolts."""
        return round(EMPTY_CELL_MV + self.percent / 100.0 * (FULL_CELL_MV - EMPTY_CELL_MV))

    @property
    def consumed_mah(self) -> int:
        """Charge drawn since a full pack."""
        capacity_mah = HOVER_CURRENT_CA / 100.0 * self._params.endurance_s / 3.6
        return round((1.0 - self.share) * capacity_mah)

    @property
    def remaining_s(self) -> int:
        """Hovering time that is left."""
        return round(self.share * self._params.endurance_s)
