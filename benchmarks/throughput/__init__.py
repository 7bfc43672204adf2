"""The rows of `benchmarks/bench_throughput.py`, the work behind them, and what is made of it."""
