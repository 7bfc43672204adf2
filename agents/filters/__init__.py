"""Training of learned estimators on simulated traffic."""
