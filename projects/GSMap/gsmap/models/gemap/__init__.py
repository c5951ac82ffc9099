"""GeMap (arXiv 2312.03341): shapes and relations of elements."""
