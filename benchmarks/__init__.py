"""Measurements of speed and memory, each a subcommand of ``python -m benchmarks``."""
