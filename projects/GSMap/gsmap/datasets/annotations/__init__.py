"""Annotation files: what a sample is, how it is stored, how it is read."""
