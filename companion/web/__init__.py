"""The live map: a web page in a process of its own, fed through a pipe that never waits."""
