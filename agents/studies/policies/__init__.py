"""Learned query policies against every baseline: frozen beforehand, run on test traffic, judged."""
