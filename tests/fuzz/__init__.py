"""Damaged files for every reader: ``PYTHONPATH=tests:tests/map_data python -m fuzz``."""
