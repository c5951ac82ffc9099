"""StreamMapNet (arXiv 2308.12570): one query per element, attention at its points, memory."""
