"""Times of a step beside those of its peers: `python -m benchmarks`."""
