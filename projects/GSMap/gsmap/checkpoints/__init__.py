"""Checkpoints of the earlier systems: their names, conversion both ways, strict loading."""
