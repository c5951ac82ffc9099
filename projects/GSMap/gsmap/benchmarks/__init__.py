"""Measurements of speed and memory, each a subcommand of ``tools/benchmark.py``."""
