"""Live map: a web page in a separate process, fed through a pipe that never blocks."""
