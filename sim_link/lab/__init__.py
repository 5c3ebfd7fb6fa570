"""The laboratory: what flies, disturbs, judges and measures companion and simulator."""
