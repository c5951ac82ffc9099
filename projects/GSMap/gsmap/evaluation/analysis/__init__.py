"""Analysis of results: intervals, groups, distances, calibration, consistency, the prior."""

DISTANCE = "distance"
"""The option that asks for AP at distances from the vehicle."""
