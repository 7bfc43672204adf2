"""Search of estimator settings on training traffic."""
