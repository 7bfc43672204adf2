"""Studies on test traffic, each with its plan, measurements and report template."""
