"""What is done once, before the first flight: the configuration shown, written and set up."""
