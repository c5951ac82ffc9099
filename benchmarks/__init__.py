"""Measurements of speed and memory: one subcommand of ``python -m benchmarks`` each."""
