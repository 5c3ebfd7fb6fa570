"""The numbers that a monitor judges by."""

from __future__ import annotations

from companion.domain import NonNegative, Params, Positive

Corners = tuple[tuple[float, float], ...]

TICK_S = 0.05
"""One control tick, the slowest: how late an answer to a frame may be."""


class Rules(Params, frozen=True):
    """What must hold; positions in the world's frame, east and north about the first origin."""

    fence_enu_m: Corners
    system_id: int | None = None
    """The vehicle that the companion was told to follow; None: the first that it hears."""
    keep_out_enu_m: tuple[Corners, ...] = ()
    altitude_min_m: Positive = 5.0
    """Above home."""
    altitude_max_m: Positive = 60.0
    speed_mps: Positive = 5.0
    climb_mps: Positive = 2.0
    acceleration_mps2: Positive = 2.5
    step_m: Positive = 8.0
    latency_s: NonNegative = 0.5
    """From a motion that is measured to a setpoint that is obeyed."""
    navigation_sigma_m: NonNegative = 0.3
    state_age_s: Positive = 0.5
    """An own position older than this is not flown on."""
    answer_s: Positive = TICK_S
    """After a frame that ends control, this long a setpoint may still leave."""
    gap_s: Positive = 0.1
    """Longest silence of the setpoints while in control."""
    silence_s: Positive = 10.0
    """Without a HEARTBEAT for this long nobody knows who flies: the companion may fall silent."""
    stall_s: Positive = 0.5
    """A control tick later than this must have stopped heartbeat and setpoints."""
    sent_frames_per_s: Positive = 150.0
    sent_bytes_per_s: Positive = 15_000.0
    records_per_s: Positive = 60.0
    position_sigma_most_m: Positive = 2000.0
    """Bound of the estimate's standard deviation."""

    @property
    def clearance_m(self) -> float:
        """What every setpoint keeps from a border: three standard deviations."""
        return 3.0 * self.navigation_sigma_m
