"""Helpers for all packages, independent of traffic, privacy and queries."""
