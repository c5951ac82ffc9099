"""Comparison of the models with reference outputs of the earlier systems."""
