"""Estimators on filterpy: what a reader checks the equations against."""
