"""The estimate of one target: filters, window, screening, integrity, noise, and the tracker."""
