"""What a guarantee of privacy costs, and what noise as printed gives: planned, run, reported."""
