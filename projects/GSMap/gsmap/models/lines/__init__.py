"""Heads of lines with masks, whose classes have queries of their own: shared by two methods."""
