"""Laboratory that flies, disturbs, judges and measures companion and simulator."""
