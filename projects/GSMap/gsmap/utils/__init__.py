"""Helpers for all packages: files, processes, errors of commands."""
