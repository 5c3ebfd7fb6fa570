"""The names of a flight directory's files."""

TLOG, MCAP, EVENTS, INPUTS = "flight.tlog", "flight.mcap", "events.jsonl", "flight.inputs"
FLIGHT, RESULT, REPORT = "flight.json", "result.json", "report.html"
