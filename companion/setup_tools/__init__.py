"""Tools for use before the first flight: the configuration shown, written and set up."""
