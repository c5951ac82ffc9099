"""Comparisons of configs (tools/compare.py): plan, processes, tables and curves."""
