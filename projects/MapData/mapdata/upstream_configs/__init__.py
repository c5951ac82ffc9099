"""Conversion of configs of the original repositories to GSMap configs, without running them."""
