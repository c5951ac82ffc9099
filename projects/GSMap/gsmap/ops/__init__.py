"""Rasterizers and other tensor operations, each beside a plain torch reference."""
