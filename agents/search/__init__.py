"""Search of estimator settings and of open-loop plans on training traffic."""
