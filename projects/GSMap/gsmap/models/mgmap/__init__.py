"""MGMap (arXiv 2404.00876), with instance masks that activate queries and refine points."""
