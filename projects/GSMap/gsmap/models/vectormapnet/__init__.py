"""VectorMapNet (ICML 2023), which generates the points of each element one after another."""
