"""Heads of lines with masks, with separate queries for each class: shared by two methods."""
