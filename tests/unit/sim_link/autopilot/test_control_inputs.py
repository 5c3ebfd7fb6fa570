"""State that the simulated autopilot keeps of the setpoints that it receives."""

from __future__ import annotations

from sim_link.autopilot.control_inputs import Setpoint, SetpointMonitor


def test_the_longest_gap_is_between_valid_setpoints_that_are_flown() -> None:
    monitor = SetpointMonitor()
    valid = Setpoint()
    for now_s, setpoint, is_flown in (
        (1.0, valid, False),
        (9.0, valid, False),  # nothing is flown yet
        (9.1, valid, True),
        (9.3, None, True),  # refused: the stream still waits
        (9.4, valid, True),
        (9.5, valid, True),
    ):
        monitor.take(setpoint, now_s, is_flown=is_flown)
    assert round(monitor.longest_gap_s, 6) == 0.3
