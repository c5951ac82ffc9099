"""Analysis of results: intervals, groups, distances, calibration, drives, changes, the prior."""

DISTANCE = "distance"
"""Option of ``--by`` that computes AP in bands of distance from the vehicle."""
CHANGES_SUFFIX = ".geojson"
"""End of the name of a file of changes."""
