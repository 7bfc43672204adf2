"""Command-line entry points, one job each."""
