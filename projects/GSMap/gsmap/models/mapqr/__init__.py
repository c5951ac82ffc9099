"""MapQR (arXiv 2402.17430): instance queries with scatter-and-gather attention."""
