"""Options and analyses of ``tools/evaluate.py``."""
