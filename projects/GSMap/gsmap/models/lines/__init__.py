"""Heads of lines with masks, with separate queries for each class, for BeMapNet and PivotNet."""
