"""Matching of predicted to ground-truth map elements."""
