"""Analysis of results: intervals, groups, distances, calibration, consistency, the prior."""
