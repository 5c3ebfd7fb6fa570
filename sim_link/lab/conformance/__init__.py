"""MAVLink rules as probes, run against any vehicle or companion: in memory or over a real link."""
