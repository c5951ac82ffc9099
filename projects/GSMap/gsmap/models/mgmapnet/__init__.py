"""MGMapNet (arXiv 2410.07733), with queries of instances and of points."""
