"""Learned query policies against every baseline: frozen, run on test traffic once, judged."""
