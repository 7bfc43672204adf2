"""The adversary of an audit: two worlds, whom to look for, what to ask, and how to score it."""
