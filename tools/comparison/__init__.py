"""Comparisons of configs (tools/compare.py): what to run, running it, the table of it."""
