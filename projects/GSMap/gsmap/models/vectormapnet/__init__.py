"""VectorMapNet (Liu et al., ICML 2023)."""
