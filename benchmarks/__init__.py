"""Benchmarks: `python -m benchmarks` prints a table of medians and writes it as JSON."""
