"""Analysis of results: intervals, groups, distances, calibration, consistency, the prior."""

DISTANCE = "distance"
"""Option of ``--by`` that computes AP in bands of distance from the vehicle."""
