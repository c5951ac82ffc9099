"""Configs of the original repositories, read without running them and turned into ours."""
