"""HRMapNet (arXiv 2409.00620): a raster map of earlier frames as an input."""
