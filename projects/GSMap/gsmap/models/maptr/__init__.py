"""MapTR (arXiv 2208.14437): ordered points, each with a query."""
