"""Helpers that every package uses and that know nothing of traffic, privacy or queries."""
