"""Argoverse 2: logs and maps to annotation files."""
