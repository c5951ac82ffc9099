"""BeMapNet (arXiv 2306.09700): elements as piecewise Bezier curves."""
