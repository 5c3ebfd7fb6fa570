"""From ranging measurements to the estimates of one or more emitters."""
