"""A page about results, in one HTML file: figures, curves, and every frame to look at."""
