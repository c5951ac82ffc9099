"""MGMap (arXiv 2404.00876): masks of instances activate the queries, patches refine the points."""
