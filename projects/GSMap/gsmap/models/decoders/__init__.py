"""Decoders of map queries."""
