"""The names of a flight directory's files."""

TLOG, EVENTS, INPUTS = "flight.tlog", "events.jsonl", "flight.inputs"
FLIGHT, RESULT, REPORT = "flight.json", "result.json", "report.html"
