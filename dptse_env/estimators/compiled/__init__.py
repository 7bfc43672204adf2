"""Estimators compiled with numba."""
