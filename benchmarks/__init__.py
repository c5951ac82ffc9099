"""Measurements of speed and memory. Each is a subcommand of ``python -m benchmarks``."""
