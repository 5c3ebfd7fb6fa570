"""Screening of measurements before the filter: validity, plausibility, units."""
