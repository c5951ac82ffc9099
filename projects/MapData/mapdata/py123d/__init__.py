"""Logs of the library py123d, which converts several data sets to one format."""
