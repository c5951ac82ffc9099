"""BeMapNet (arXiv 2306.09700), which predicts elements as piecewise Bezier curves."""
