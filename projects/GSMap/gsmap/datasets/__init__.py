"""Annotation files, data sets, transforms and converters."""
