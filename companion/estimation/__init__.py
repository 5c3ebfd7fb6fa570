"""Filters, losses and the estimate's honesty."""
