"""StreamMapNet (arXiv 2308.12570), with one query per element and a memory of earlier frames."""
