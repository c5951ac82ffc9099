"""Converters from data sets to annotation files."""
