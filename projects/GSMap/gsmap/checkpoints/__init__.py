"""Checkpoints: loading with checks, conversion from and to earlier systems, and named models."""
