"""MGMapNet (arXiv 2410.07733): instance and point queries."""
