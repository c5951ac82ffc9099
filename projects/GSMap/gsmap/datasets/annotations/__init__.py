"""Annotation files: records of samples, file format, reader and writer."""
