"""The rows of `benchmarks/bench_throughput.py`, the work behind them, and their tables."""
