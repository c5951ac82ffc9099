"""MapTR (arXiv 2208.14437): points in order, each with a query of its own."""
