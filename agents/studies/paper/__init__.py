"""The paper's five results: planned, run, judged, drawn and reported."""
