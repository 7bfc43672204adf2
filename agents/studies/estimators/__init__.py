"""Estimators side by side: errors, honesty of deviations, and what holds off the training."""
