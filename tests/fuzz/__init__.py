"""Damaged and crafted files for every reader: ``PYTHONPATH=tests python -m fuzz --cases 5000``."""
