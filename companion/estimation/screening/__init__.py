"""Which measurements may reach the filter: validity, gate, plausibility, units."""
