"""What the filter believes about motion and measurements."""
